//! `[[zone]]`: its keys.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::{MAX_NAME, ZoneError, check_all, checked, shape_error, too_many};
use super::degrees::Coordinates;
use super::geojson;
use super::shape::Shape;
use super::zone::{MAX_ZONES, Zone, ZoneKind};
use crate::geo::LocalAxes;
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
    /// What the file's corners are.
    #[serde(default)]
    pub coordinates: Coordinates,
    #[serde(default)]
    pub users: Vec<String>,
    #[serde(default)]
    pub tolerated_distance_m: Option<f64>,
    #[serde(default)]
    pub severity: Option<Severity>,
    #[serde(default)]
    pub webhooks: Option<Vec<String>>,
}

/// The zones of a config, checked; `axes` are those of `[world] origin`.
pub fn load(configs: &[Config], axes: Option<&LocalAxes>) -> Result<Vec<Zone>, ZoneError> {
    if configs.len() > MAX_ZONES {
        return Err(too_many(configs.len()));
    }
    let zones = configs.iter().enumerate().map(|(k, config)| config.zone(k + 1, axes));
    let zones = zones.collect::<Result<Vec<_>, _>>()?;
    check_all(&zones)?;
    Ok(zones)
}

impl Config {
    fn zone(&self, number: usize, axes: Option<&LocalAxes>) -> Result<Zone, ZoneError> {
        let name: String = self.name.chars().take(MAX_NAME).collect();
        let place = |key: &str| format!("zone {number} ({name:?}): {key}");
        if self.polygon.is_some() && self.coordinates == Coordinates::Degrees {
            let reason = "expected metres with polygon, found degrees; a geojson file may have them";
            return Err(ZoneError::new(place("coordinates"), reason));
        }
        let shape = match (&self.polygon, &self.geojson) {
            (Some(corners), None) => {
                Shape::new(vec![vec![corners.clone()]]).map_err(|e| shape_error(&e, &place("polygon")))?
            }
            (None, Some(path)) => read(path, &place("geojson"), self.coordinates, axes)?,
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

fn read(
    path: &std::path::Path,
    place: &str,
    coordinates: Coordinates,
    axes: Option<&LocalAxes>,
) -> Result<Shape, ZoneError> {
    let fault = |reason: String| ZoneError::new(format!("{place}: {}", path.display()), reason);
    let size = std::fs::metadata(path).map_err(|e| fault(e.to_string()))?.len();
    if size > MAX_FILE {
        return Err(fault(format!("expected at most {MAX_FILE} bytes, found {size}")));
    }
    let text = std::fs::read_to_string(path).map_err(|e| fault(e.to_string()))?;
    let mut value = serde_json::from_str(&text).map_err(|e| fault(format!("expected GeoJSON, found {e}")))?;
    let shape = coordinates
        .read(&mut value, axes)
        .and_then(|()| geojson::shape_of_all(&value));
    shape.map_err(|e| fault(format!("{}: {}", e.place, e.reason)))
}
