//! One line of the claims log or of a POST as a claim.

use jiff::{SignedDuration, Timestamp};
use serde_json::Value;

use super::config::Config;
use super::ellipse::checked_cov;
use crate::claim::{Claim, ClaimState, escape_undisplayable, is_displayable_name};
use crate::geo::{Geodetic, LocalAxes};

/// Longest user name accepted, in bytes.
const LONGEST_USER: usize = 256;
/// A local coordinate beyond this is a mistake of units or axes.
const FARTHEST_M: f64 = 1e7;

/// Some editors and Windows programs begin a UTF-8 file with it.
pub(super) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// Why a line is no claim.
#[derive(Debug, thiserror::Error)]
pub enum LineError {
    #[error("not a JSON object: {0}")]
    NotJson(#[from] serde_json::Error),
    #[error("field `{field}` is missing: expected {expected}")]
    Missing { field: String, expected: &'static str },
    #[error("field `{field}`: expected {expected}, found {found}")]
    Wrong {
        field: String,
        expected: &'static str,
        found: String,
    },
    #[error("not an XML event: {0}")]
    NotXml(String),
    #[error("not comma-separated: {0}")]
    NotCsv(#[from] csv::Error),
    #[error("expected {expected} cells as in the header, found {found}")]
    Columns { expected: usize, found: usize },
    #[error("expected a header before it, found none")]
    NoHeader,
    #[error("latitude and longitude need [world] origin, which places them on the earth; the config has none")]
    NoOrigin,
    #[error("the line is longer than {limit} bytes")]
    TooLong { limit: usize },
}

/// A line as a JSON object.
pub(super) fn object(line: &[u8]) -> Result<Value, LineError> {
    let line = line.strip_prefix(BYTE_ORDER_MARK).unwrap_or(line);
    let object: Value = serde_json::from_slice(line)?;
    match object.is_object() {
        true => Ok(object),
        false => Err(wrong("the line", "a JSON object", &object)),
    }
}

/// Reads an object with the fields that `config` names, by default
/// `{"time", "user", "x_m", "y_m", "sigma_m"?, "cov_m2"?, "power_w"?, "state"?}`. Other fields are ignored.
pub(super) fn parse_object(object: &Value, config: &Config) -> Result<Claim, LineError> {
    let names = &config.fields;
    let time = time(&names.time, required(object, &names.time, TIME)?, config.clock_offset_s)?;
    let user = user(&names.user, required(object, &names.user, USER)?)?;
    let metre = |name: &str| number(object, name, METRES, is_near);
    let ([x_m, y_m], z_m) = match optional(object, &names.latitude_deg) {
        Some(_) => place(
            object,
            &names.latitude_deg,
            &names.longitude_deg,
            &names.height_m,
            config,
        )?,
        None => {
            let z_m = optional(object, &names.z_m).map(|_| metre(&names.z_m)).transpose()?;
            ([metre(&names.x_m)?, metre(&names.y_m)?], z_m)
        }
    };
    let sigma_m = match optional(object, &names.sigma_m) {
        None => None,
        Some(_) => Some(number(object, &names.sigma_m, SIGMA, |s| s >= 0.0)?),
    };
    let cov_m2 = match optional(object, &names.cov_m2) {
        None => None,
        Some(value) => {
            let cov = serde_json::from_value(value.clone()).ok().and_then(checked_cov);
            Some(cov.ok_or_else(|| wrong(&names.cov_m2, COV, value))?)
        }
    };
    let power_w = match optional(object, &names.power_w) {
        None => None,
        Some(_) => Some(number(object, &names.power_w, POWER, |p| p >= 0.0)?),
    };
    let state = match optional(object, &names.state) {
        None => ClaimState::Active,
        Some(value) => match value.as_str() {
            Some("active") => ClaimState::Active,
            Some("ended") => ClaimState::Ended,
            _ => return Err(wrong(&names.state, "\"active\" or \"ended\"", value)),
        },
    };
    Ok(Claim {
        z_m,
        sigma_m,
        cov_m2,
        power_w,
        state,
        ..Claim::at(time, user, [x_m, y_m])
    })
}

/// A place in degrees under these names, in our axes, m, with its height where one is stated under that name.
pub(super) fn place(
    object: &Value,
    latitude: &str,
    longitude: &str,
    height: &str,
    config: &Config,
) -> Result<([f64; 2], Option<f64>), LineError> {
    let latitude_deg = number(object, latitude, LATITUDE, |l| l.abs() <= 90.0)?;
    let longitude_deg = number(object, longitude, LONGITUDE, |l| l.abs() <= 180.0)?;
    let height_m = optional(object, height)
        .map(|_| number(object, height, METRES, is_near))
        .transpose()?;
    let axes = config.axes.as_ref().ok_or(LineError::NoOrigin)?;
    Ok(local_metres(axes, latitude_deg, longitude_deg, height_m))
}

/// Whether a coordinate is one, in metres.
pub(super) fn is_near(metres: f64) -> bool {
    metres.abs() <= FARTHEST_M
}

pub(super) const TIME: &str = "an RFC 3339 time or seconds since 1970";
pub(super) const USER: &str = "a name of 1 to 256 visible characters, without white space at its ends";
pub(super) const METRES: &str = "metres within 10000 km of the origin";
const LATITUDE: &str = "degrees between -90 and 90";
const LONGITUDE: &str = "degrees between -180 and 180";
const SIGMA: &str = "metres, zero or more";
const COV: &str = "[[xx, xy], [xy, yy]] in m², symmetric and not negative";
const POWER: &str = "watts, zero or more";

pub(super) fn optional<'a>(object: &'a Value, name: &str) -> Option<&'a Value> {
    let value = if name.starts_with('/') {
        object.pointer(name)
    } else {
        object.get(name)
    };
    value.filter(|v| !v.is_null())
}

pub(super) fn required<'a>(object: &'a Value, name: &str, expected: &'static str) -> Result<&'a Value, LineError> {
    optional(object, name).ok_or_else(|| LineError::Missing {
        field: name.to_owned(),
        expected,
    })
}

pub(super) fn wrong(field: &str, expected: &'static str, found: &Value) -> LineError {
    let mut found = escape_undisplayable(&found.to_string()).into_owned();
    if found.len() > 80 {
        let cut = (0..=77).rev().find(|&i| found.is_char_boundary(i)).unwrap_or(0);
        found.truncate(cut);
        found.push('…');
    }
    LineError::Wrong {
        field: field.to_owned(),
        expected,
        found,
    }
}

pub(super) fn number(
    object: &Value,
    name: &str,
    expected: &'static str,
    fits: impl Fn(f64) -> bool,
) -> Result<f64, LineError> {
    let value = required(object, name, expected)?;
    match value.as_f64() {
        Some(x) if x.is_finite() && fits(x) => Ok(x),
        _ => Err(wrong(name, expected, value)),
    }
}

pub(super) fn user(name: &str, value: &Value) -> Result<String, LineError> {
    let user = match value {
        Value::String(s) => s.clone(),
        Value::Number(n) => n.to_string(),
        _ => return Err(wrong(name, USER, value)),
    };
    if user.chars().count() > LONGEST_USER || !is_displayable_name(&user) {
        return Err(wrong(name, USER, value));
    }
    Ok(user)
}

pub(super) fn time(name: &str, value: &Value, offset_s: f64) -> Result<Timestamp, LineError> {
    let stamp = match value {
        // RFC 3339 knows four digits of a year.
        Value::String(s) if s.starts_with(|c: char| c.is_ascii_digit()) => s.parse::<Timestamp>().ok(),
        Value::Number(n) => n
            .as_f64()
            .filter(|s| (0.0..1e11).contains(s))
            .and_then(|s| Timestamp::from_nanosecond((s * 1e9).round() as i128).ok()),
        _ => None,
    };
    let offset = SignedDuration::from_secs_f64(offset_s);
    stamp
        .and_then(|t| t.checked_add(offset).ok())
        .ok_or_else(|| wrong(name, TIME, value))
}

/// East and north metres of a place about the world's origin, and its height above it where one is stated. Without one it is as
/// high as the origin: a height moves east and north by a ten-thousandth of it within a kilometre.
fn local_metres(
    axes: &LocalAxes,
    latitude_deg: f64,
    longitude_deg: f64,
    height_m: Option<f64>,
) -> ([f64; 2], Option<f64>) {
    let [x, y, z] = axes.to_local(Geodetic {
        latitude_deg,
        longitude_deg,
        height_m: height_m.unwrap_or(axes.height_m()),
    });
    ([x, y], height_m.map(|_| z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claims::parse_line;

    fn parse(line: &str) -> Result<Claim, LineError> {
        parse_line(line.as_bytes(), &Config::default())
    }

    #[test]
    fn reads_the_contracts_line_and_its_short_form() {
        let c = parse(
            r#"{"time":"2026-11-21T08:00:00.000Z","user":"u-17","x_m":12.5,"y_m":-80.0,"sigma_m":1.0,"state":"ended"}"#,
        )
        .unwrap();
        assert_eq!(
            (c.user.as_str(), c.x_m, c.y_m, c.sigma_m),
            ("u-17", 12.5, -80.0, Some(1.0))
        );
        assert_eq!(c.state, ClaimState::Ended);
        let c = parse(r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":2,"more":[]}"#).unwrap();
        assert_eq!((c.sigma_m, c.state), (None, ClaimState::Active));
    }

    /// What is recorded must be reviewed to the same alerts, byte for byte.
    #[test]
    fn numbers_survive_being_written_and_read() {
        for k in 0..10_000u64 {
            let x_m = 100.0 * (k as f64).sin();
            let line = format!(r#"{{"time":"2026-11-21T08:00:00Z","user":"u","x_m":{x_m:?},"y_m":2}}"#);
            let claim = parse(&line).unwrap();
            assert_eq!(claim.x_m.to_bits(), x_m.to_bits(), "{x_m:?}");
            let again: Claim = serde_json::from_str(&serde_json::to_string(&claim).unwrap()).unwrap();
            assert_eq!(again, claim);
        }
    }

    #[test]
    fn names_the_field_that_is_wrong() {
        for (line, field) in [
            (r#"{"user":"u","x_m":1,"y_m":2}"#, "time"),
            (r#"{"time":"yesterday","user":"u","x_m":1,"y_m":2}"#, "time"),
            (r#"{"time":"2026-11-21T08:00:00Z","user":"","x_m":1,"y_m":2}"#, "user"),
            (r#"{"time":"2026-11-21T08:00:00Z","user":" ","x_m":1,"y_m":2}"#, "user"),
            (
                "{\"time\":\"2026-11-21T08:00:00Z\",\"user\":\"u-1\u{200b}\",\"x_m\":1,\"y_m\":2}",
                "user",
            ),
            (
                "{\"time\":\"2026-11-21T08:00:00Z\",\"user\":\"u-\u{202e}1\",\"x_m\":1,\"y_m\":2}",
                "user",
            ),
            (r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":"1","y_m":2}"#, "x_m"),
            (
                r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":1e300}"#,
                "y_m",
            ),
            (
                r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":2,"sigma_m":-1}"#,
                "sigma_m",
            ),
            (
                r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":2,"state":"gone"}"#,
                "state",
            ),
        ] {
            let message = parse(line).unwrap_err().to_string();
            assert!(message.contains(&format!("`{field}`")), "{line}: {message}");
            assert!(
                !message.contains(['\u{200b}', '\u{202e}']),
                "what is not seen is spelled out: {message}"
            );
        }
        assert!(matches!(parse("{\"time\""), Err(LineError::NotJson(_))));
        assert!(matches!(parse("[1]"), Err(LineError::Wrong { .. })));
    }

    #[test]
    fn fields_can_be_mapped_and_positions_geodetic() {
        let mut config = Config::default();
        config.fields.time = "ts".into();
        config.fields.latitude_deg = "/pos/lat".into();
        config.fields.longitude_deg = "/pos/lon".into();
        let line = br#"{"ts":1795248000,"user":7,"pos":{"lat":48.001,"lon":11.001}}"#;
        let error = parse_line(line, &config).unwrap_err().to_string();
        assert!(error.contains("[world] origin"), "{error}");
        config.axes = Some(LocalAxes::at(Geodetic {
            latitude_deg: 48.0,
            longitude_deg: 11.0,
            height_m: 0.0,
        }));
        config.clock_offset_s = 1.5;
        let c = parse_line(line, &config).unwrap();
        // One degree of latitude at 48° is 111.20 km, one of longitude 74.63 km (tables of WGS 84).
        assert!((c.y_m - 111.2).abs() < 0.01, "{}", c.y_m);
        assert!((c.x_m - 74.63).abs() < 0.01, "{}", c.x_m);
        assert_eq!(c.user, "7");
        assert_eq!(c.time.as_millisecond(), 1_795_248_001_500);
        assert_eq!(c.z_m, None);
        let line = br#"{"ts":1795248000,"user":7,"pos":{"lat":48.001,"lon":11.001},"height_m":12.5}"#;
        assert!((parse_line(line, &config).unwrap().z_m.unwrap() - 12.5).abs() < 2e-3);
        // Local metres stay possible beside an origin.
        let local = br#"{"ts":1795248000,"user":7,"x_m":3,"y_m":4,"z_m":5}"#;
        let c = parse_line(local, &config).unwrap();
        assert_eq!((c.x_m, c.y_m, c.z_m), (3.0, 4.0, Some(5.0)));
    }
}
