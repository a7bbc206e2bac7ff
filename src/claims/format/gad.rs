//! 3GPP: universal geographical area descriptions (TS 23.032) in the JSON of TS 29.572, with the user and the time beside them.

use serde_json::Value;

use crate::claim::Claim;
use crate::claims::config::Config;
use crate::claims::ellipse;
use crate::claims::line::{self, LineError, number, optional, required, wrong};

const SHAPE: &str = "POINT, POINT_UNCERTAINTY_CIRCLE, POINT_UNCERTAINTY_ELLIPSE or LOCAL_2D_POINT_UNCERTAINTY_ELLIPSE";
const UNCERTAINTY: &str = "metres, zero or more";
const ANGLE: &str = "degrees from 0 to 180";
/// These shapes are flat.
const NO_HEIGHT: &str = "/none";
const CONFIDENCE: &str = "percent from 0 to 100";

/// Reads an object with `locationEstimate` (or with the shape's own fields), `gpsi` or `supi` and `timestampOfLocationEstimate`; the last two under
/// the names of `[claims.fields]` too.
pub(super) fn parse(object: &Value, config: &Config) -> Result<Claim, LineError> {
    let names = &config.fields;
    let user_field = [names.user.as_str(), "gpsi", "supi"]
        .into_iter()
        .find(|name| optional(object, name).is_some())
        .unwrap_or("gpsi");
    let time_field = match optional(object, &names.time) {
        Some(_) => names.time.as_str(),
        None => "timestampOfLocationEstimate",
    };
    let shape = optional(object, "locationEstimate").unwrap_or(object);
    let kind = required(shape, "shape", SHAPE)?;
    let ([x_m, y_m], cov_m2) = match kind.as_str() {
        Some("POINT") => (place(shape, "/point", config)?, None),
        Some("POINT_UNCERTAINTY_CIRCLE") => {
            let radius = number(shape, "uncertainty", UNCERTAINTY, |m| m >= 0.0)?;
            let cov = ellipse::covariance([radius, radius], 0.0, config.confidence);
            (place(shape, "/point", config)?, Some(cov))
        }
        Some("POINT_UNCERTAINTY_ELLIPSE") => {
            let cov = uncertainty(shape, config)?;
            (place(shape, "/point", config)?, Some(cov))
        }
        Some("LOCAL_2D_POINT_UNCERTAINTY_ELLIPSE") => {
            let metre = |name| number(shape, name, line::METRES, line::is_near);
            let offset = [metre("/point/x")?, metre("/point/y")?];
            // Without a place of its own the local origin is ours.
            let origin = match optional(shape, "/localOrigin/point") {
                Some(_) => place(shape, "/localOrigin/point", config)?,
                None => [0.0, 0.0],
            };
            (
                [origin[0] + offset[0], origin[1] + offset[1]],
                Some(uncertainty(shape, config)?),
            )
        }
        _ => return Err(wrong("shape", SHAPE, kind)),
    };
    Ok(Claim {
        cov_m2,
        ..Claim::at(
            line::time(
                time_field,
                required(object, time_field, line::TIME)?,
                config.clock_offset_s,
            )?,
            line::user(user_field, required(object, user_field, line::USER)?)?,
            [x_m, y_m],
        )
    })
}

fn place(shape: &Value, point: &str, config: &Config) -> Result<[f64; 2], LineError> {
    let (place, _) = line::place(
        shape,
        &format!("{point}/lat"),
        &format!("{point}/lon"),
        NO_HEIGHT,
        config,
    )?;
    Ok(place)
}

/// The covariance of an `uncertaintyEllipse`; its longer axis is turned clockwise from north, or from y where the point is local.
fn uncertainty(shape: &Value, config: &Config) -> Result<[[f64; 2]; 2], LineError> {
    let axis = |name| number(shape, name, UNCERTAINTY, |m| m >= 0.0);
    let half_axes = [
        axis("/uncertaintyEllipse/semiMajor")?,
        axis("/uncertaintyEllipse/semiMinor")?,
    ];
    let angle = number(shape, "/uncertaintyEllipse/orientationMajor", ANGLE, |a| {
        (0.0..=180.0).contains(&a)
    })?;
    let confidence = match optional(shape, "confidence") {
        None => config.confidence,
        Some(_) => match number(shape, "confidence", CONFIDENCE, |c| (0.0..=100.0).contains(&c))? {
            // "No information" (TS 23.032, section 6.5).
            0.0 => config.confidence,
            percent => percent / 100.0,
        },
    };
    Ok(ellipse::covariance(half_axes, angle, confidence))
}
