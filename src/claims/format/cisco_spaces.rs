//! Cisco Spaces Firehose: events of the type `DEVICE_LOCATION_UPDATE`.

use serde_json::Value;

use crate::claim::Claim;
use crate::claims::config::Config;
use crate::claims::ellipse;
use crate::claims::line::{self, LineError, number, optional, required, wrong};

/// Of `confidenceFactor`: the radius within which a device is at 95 %, in feet.
const CONFIDENCE: f64 = 0.95;
const FOOT_M: f64 = 0.3048;
const TYPE: &str = "DEVICE_LOCATION_UPDATE";
const MILLISECONDS: &str = "milliseconds since 1970";

/// A device by its `userId`, else its `macAddress`, else its `deviceId`.
pub(super) fn parse(object: &Value, config: &Config) -> Result<Claim, LineError> {
    let kind = required(object, "eventType", TYPE)?;
    if kind.as_str() != Some(TYPE) {
        return Err(wrong("eventType", TYPE, kind));
    }
    let update = required(object, "deviceLocationUpdate", "an object")?;
    let names = ["/device/userId", "/device/macAddress", "/device/deviceId"];
    let is_given = |name: &&str| optional(update, name).is_some_and(|v| v.as_str().is_none_or(|text| !text.is_empty()));
    let user = names.into_iter().find(is_given).unwrap_or(names[2]);
    let (of, time) = match optional(update, "lastSeen") {
        Some(_) => (update, "lastSeen"),
        None => (object, "recordTimestamp"),
    };
    let seconds = number(of, time, MILLISECONDS, |ms| (0.0..1e14).contains(&ms))? * 1e-3;
    let cov_m2 = match optional(update, "confidenceFactor") {
        None => None,
        Some(_) => {
            let radius = FOOT_M * number(update, "confidenceFactor", "feet, zero or more", |feet| feet >= 0.0)?;
            Some(ellipse::covariance([radius, radius], 0.0, CONFIDENCE))
        }
    };
    Ok(Claim {
        cov_m2,
        ..Claim::at(
            line::time(time, &Value::from(seconds), config.clock_offset_s)?,
            line::user(user, required(update, user, line::USER)?)?,
            // −999 stands for a map that nobody placed on the earth.
            line::place(update, "latitude", "longitude", "/none", config)?.0,
        )
    })
}
