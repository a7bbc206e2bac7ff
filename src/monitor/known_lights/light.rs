//! One known light: where it is, who approved it, why and until when.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::range::Learned;
use crate::hash::fnv1a;
use crate::monitor::zones::MAX_COORDINATE_M;

/// Known lights of the config and of the API together; bounds what a frame costs.
pub const MAX_LIGHTS: usize = 200;
/// Radius of a known light whose approval states none, until its own movement has been learned, m.
pub const DEFAULT_RADIUS_M: f64 = 2.0;
/// Smallest and largest radius, m. A light that moves farther is a vehicle, for which a zone is the means.
pub const RADIUS_M: std::ops::RangeInclusive<f64> = 0.1..=50.0;
/// Characters of a note.
const MAX_NOTE: usize = 1000;

/// One `[[known_light]]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub x_m: f64,
    pub y_m: f64,
    /// How far the light may be from there; it follows from what is learned when left out.
    #[serde(default)]
    pub radius_m: Option<f64>,
    #[serde(default)]
    pub note: Option<String>,
    /// When the approval ends; never when left out.
    #[serde(default)]
    pub until: Option<Timestamp>,
}

/// Where a known light comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum LightSource {
    /// `[[known_light]]`, which the API does not change.
    Config,
    /// An approval through the API.
    Api,
}

/// A known light, as the API shows it and the journal keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct KnownLight {
    pub id: String,
    pub x_m: f64,
    pub y_m: f64,
    /// How far the light may be from there, m.
    pub radius_m: f64,
    pub note: Option<String>,
    /// When the approval ends; never when null.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub until: Option<Timestamp>,
    /// Name of the operator's token; null where it has none, or for the config.
    pub by: Option<String>,
    /// When it was approved; null for the config.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub at: Option<Timestamp>,
    /// The alert whose emitter was approved.
    pub alert: Option<String>,
    pub source: LightSource,
    /// Whether `radius_m` was stated; else it follows from what is learned.
    #[serde(default)]
    pub is_radius_stated: bool,
    /// What its track has shown; null until it has been seen for long enough.
    pub learned: Option<Learned>,
}

/// What an operator approves.
#[derive(Clone, Debug, PartialEq)]
pub struct Request {
    /// A place and a radius, or the id of an alert.
    pub place: Result<([f64; 2], Option<f64>), String>,
    pub note: Option<String>,
    pub until: Option<Timestamp>,
    pub by: Option<String>,
    /// The frames' clock.
    pub at: Timestamp,
}

/// Why a known light cannot be taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LightError {
    #[error("{key}: expected {expected}, found {found}")]
    Value {
        key: &'static str,
        expected: &'static str,
        found: String,
    },
    #[error("until: expected a time after the frames' clock, {now}, found {found}")]
    Past { now: Timestamp, found: Timestamp },
    #[error("expected at most {limit} known lights, found {limit} and another")]
    TooMany { limit: usize },
    #[error("no open alert has the id {0:?}")]
    NoAlert(String),
    #[error(
        "alert {id:?} is about {kind}; expected an unclaimed emitter that stands alone, or a known light that changed"
    )]
    NoEmitter { id: String, kind: &'static str },
    #[error("a known light is there already: {0:?}")]
    Taken(String),
    #[error("no known light has the id {0:?}")]
    Unknown(String),
    #[error("known light {0:?} is set in the config, not through the API")]
    Fixed(String),
    #[error("a hub has none of its own: set them at the access points")]
    AtHub,
    #[error("alert {0:?} has cleared; only the emitter of an alert that stands can be approved")]
    Cleared(String),
}

impl KnownLight {
    /// Checks the numbers and the note.
    pub fn check(&self) -> Result<(), LightError> {
        const COORDINATE: &str = "-100000 to 100000 (metres; no camera sees farther)";
        for (key, value) in [("x_m", self.x_m), ("y_m", self.y_m)] {
            if !(value.is_finite() && value.abs() <= MAX_COORDINATE_M) {
                return Err(LightError::Value {
                    key,
                    expected: COORDINATE,
                    found: value.to_string(),
                });
            }
        }
        if !RADIUS_M.contains(&self.radius_m) {
            return Err(LightError::Value {
                key: "radius_m",
                expected: "0.1 to 50 (metres; for a light that moves farther, use a zone)",
                found: self.radius_m.to_string(),
            });
        }
        let is_odd = |c: char| c.is_control() && !['\n', '\r', '\t'].contains(&c);
        let length = self.note.as_ref().map_or(0, |note| note.chars().count());
        if length > MAX_NOTE || self.note.as_ref().is_some_and(|note| note.contains(is_odd)) {
            return Err(LightError::Value {
                key: "note",
                expected: "at most 1000 characters, no control characters but line breaks and tabs",
                found: format!("{length} characters"),
            });
        }
        Ok(())
    }
}

/// The known lights of a config, checked. Their ids follow from their places, so that what is learned outlasts a restart.
pub fn from_config(configs: &[Config]) -> Result<Vec<KnownLight>, String> {
    let mut lights: Vec<KnownLight> = Vec::new();
    for (k, config) in configs.iter().enumerate() {
        let place = [config.x_m, config.y_m];
        let hash = fnv1a(place.iter().flat_map(|c| c.to_bits().to_le_bytes()));
        let light = KnownLight {
            id: format!("config-{:08x}", hash as u32),
            x_m: config.x_m,
            y_m: config.y_m,
            radius_m: config.radius_m.unwrap_or(DEFAULT_RADIUS_M),
            note: config.note.clone(),
            until: config.until,
            by: None,
            at: None,
            alert: None,
            source: LightSource::Config,
            is_radius_stated: config.radius_m.is_some(),
            learned: None,
        };
        light.check().map_err(|e| format!("known_light {}: {e}", k + 1))?;
        if let Some(other) = lights.iter().position(|l| l.id == light.id) {
            return Err(format!(
                "known_light {}: expected a place of its own, found that of known_light {}",
                k + 1,
                other + 1
            ));
        }
        lights.push(light);
    }
    if lights.len() > MAX_LIGHTS {
        return Err(format!(
            "known_light: expected at most {}, found {}",
            MAX_LIGHTS,
            lights.len()
        ));
    }
    Ok(lights)
}
