//! `[[zone]]`: its keys.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::{MAX_NAME, ZoneError, check_all, checked, shape_error, too_many};
use super::geojson;
use super::shape::Shape;
use super::zone::{MAX_ZONES, Zone, ZoneKind};
use crate::monitor::alert::Severity;

/// Largest GeoJSON file, bytes.
const MAX_FILE: u64 = 4 << 20;

/// One `[[zone]]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub name: String,
    pub kind: ZoneKind,
    /// Corners, metres east and north.
    #[serde(default)]
    pub polygon: Option<Vec<[f64; 2]>>,
    /// File with the polygons instead.
    #[serde(default)]
    pub geojson: Option<PathBuf>,
    #[serde(default)]
    pub users: Vec<String>,
    #[serde(default)]
    pub tolerated_distance_m: Option<f64>,
    #[serde(default)]
    pub severity: Option<Severity>,
    #[serde(default)]
    pub webhooks: Option<Vec<String>>,
}

/// The zones of a config, checked.
pub fn load(configs: &[Config]) -> Result<Vec<Zone>, ZoneError> {
    if configs.len() > MAX_ZONES {
        return Err(too_many(configs.len()));
    }
    let zones = configs.iter().enumerate().map(|(k, config)| config.zone(k + 1));
    let zones = zones.collect::<Result<Vec<_>, _>>()?;
    check_all(&zones)?;
    Ok(zones)
}

impl Config {
    fn zone(&self, number: usize) -> Result<Zone, ZoneError> {
        let name: String = self.name.chars().take(MAX_NAME).collect();
        let place = |key: &str| format!("zone {number} ({name:?}): {key}");
        let shape = match (&self.polygon, &self.geojson) {
            (Some(corners), None) => {
                Shape::new(vec![vec![corners.clone()]]).map_err(|e| shape_error(&e, &place("polygon")))?
            }
            (None, Some(path)) => read(path, &place("geojson"))?,
            (Some(_), Some(_)) => {
                return Err(ZoneError::new(
                    place("polygon"),
                    "expected polygon or geojson, found both",
                ));
            }
            (None, None) => {
                return Err(ZoneError::new(
                    place("polygon"),
                    "expected polygon or geojson, found neither",
                ));
            }
        };
        let zone = Zone {
            name: self.name.clone(),
            kind: self.kind,
            shape,
            users: self.users.clone(),
            tolerated_distance_m: self.tolerated_distance_m,
            severity: self.severity,
            webhooks: self.webhooks.clone(),
            is_fixed: true,
        };
        checked(zone, &place)
    }
}

fn read(path: &std::path::Path, place: &str) -> Result<Shape, ZoneError> {
    let fault = |reason: String| ZoneError::new(format!("{place}: {}", path.display()), reason);
    let size = std::fs::metadata(path).map_err(|e| fault(e.to_string()))?.len();
    if size > MAX_FILE {
        return Err(fault(format!("expected at most {MAX_FILE} bytes, found {size}")));
    }
    let text = std::fs::read_to_string(path).map_err(|e| fault(e.to_string()))?;
    let value = serde_json::from_str(&text).map_err(|e| fault(format!("expected GeoJSON, found {e}")))?;
    geojson::shape_of_all(&value).map_err(|e| fault(format!("{}: {}", e.place, e.reason)))
}
