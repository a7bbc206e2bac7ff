//! Corners of zones in longitude and latitude, as RFC 7946 has them.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::check::ZoneError;
use crate::geo::{Geodetic, LocalAxes};

/// What corners in GeoJSON are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Coordinates {
    /// Metres east and north.
    #[default]
    Metres,
    /// Longitude and latitude; needs `[world] origin`.
    Degrees,
}

impl Coordinates {
    /// Brings GeoJSON that was read to metres.
    ///
    /// # Errors
    /// There is no origin, or a corner is no longitude and latitude.
    pub fn read(self, value: &mut Value, axes: Option<&LocalAxes>) -> Result<(), ZoneError> {
        if self == Self::Metres {
            return Ok(());
        }
        let axes = axes.ok_or_else(no_origin)?;
        let local = |[longitude_deg, latitude_deg]: [f64; 2]| {
            if !(longitude_deg.abs() <= 180.0 && latitude_deg.abs() <= 90.0) {
                let reason = format!(
                    "expected [longitude, latitude] within 180 and 90 degrees, found [{longitude_deg}, {latitude_deg}]"
                );
                return Err(ZoneError::new("coordinates", reason));
            }
            let [x, y, _] = axes.to_local(Geodetic {
                latitude_deg,
                longitude_deg,
                height_m: axes.height_m(),
            });
            Ok([x, y])
        };
        each_corner(value, &local)
    }

    /// Brings GeoJSON in metres to what is asked for.
    ///
    /// # Errors
    /// There is no origin.
    pub fn write(self, value: &mut Value, axes: Option<&LocalAxes>) -> Result<(), ZoneError> {
        if self == Self::Metres {
            return Ok(());
        }
        let axes = axes.ok_or_else(no_origin)?;
        let geodetic = |[x, y]: [f64; 2]| {
            let place = axes.to_geodetic([x, y, 0.0]);
            Ok([place.longitude_deg, place.latitude_deg])
        };
        each_corner(value, &geodetic)
    }
}

fn no_origin() -> ZoneError {
    ZoneError::new(
        "coordinates",
        "expected [world] origin in the config for degrees, found none",
    )
}

type Change<'a> = dyn Fn([f64; 2]) -> Result<[f64; 2], ZoneError> + 'a;

/// Changes every corner below a member `coordinates`, at any depth that GeoJSON has; what is no corner is left to the reader.
fn each_corner(value: &mut Value, change: &Change) -> Result<(), ZoneError> {
    match value {
        Value::Object(members) => {
            for (key, member) in members {
                match key.as_str() {
                    "coordinates" => corners(member, change)?,
                    "features" | "geometry" => each_corner(member, change)?,
                    _ => {}
                }
            }
            Ok(())
        }
        Value::Array(items) => items.iter_mut().try_for_each(|item| each_corner(item, change)),
        _ => Ok(()),
    }
}

fn corners(value: &mut Value, change: &Change) -> Result<(), ZoneError> {
    let Value::Array(items) = value else { return Ok(()) };
    if let [a, b, ..] = &items[..]
        && let Some(corner) = a.as_f64().zip(b.as_f64())
    {
        let [x, y] = change(corner.into())?;
        items.truncate(2);
        (items[0], items[1]) = (json!(x), json!(y));
        return Ok(());
    }
    items.iter_mut().try_for_each(|item| corners(item, change))
}

#[cfg(test)]
mod tests {
    use super::super::{collection, parse};
    use super::*;

    fn axes() -> LocalAxes {
        LocalAxes::at(Geodetic {
            latitude_deg: 48.137,
            longitude_deg: 11.575,
            height_m: 520.0,
        })
    }

    fn square(low: [f64; 2], high: [f64; 2]) -> Value {
        let ring = [low, [high[0], low[1]], high, [low[0], high[1]], low];
        json!({ "type": "FeatureCollection", "features": [{
            "type": "Feature", "properties": { "name": "yard", "kind": "watch" },
            "geometry": { "type": "MultiPolygon", "coordinates": [[ring]] },
        }] })
    }

    #[test]
    fn degrees_become_metres_and_are_the_same_again() {
        let degrees = square([11.575, 48.137], [11.576, 48.138]);
        let mut value = degrees.clone();
        Coordinates::Degrees.read(&mut value, Some(&axes())).unwrap();
        let zones = parse(&value).unwrap();
        // A thousandth of a degree: 74.4 m east at this latitude, 111.2 m north.
        let area = zones[0].shape.area_m2();
        assert!((area / (74.44 * 111.20) - 1.0).abs() < 1e-3, "{area}");
        let mut told = collection(zones.iter());
        Coordinates::Degrees.write(&mut told, Some(&axes())).unwrap();
        let corner = &told["features"][0]["geometry"]["coordinates"][0][2];
        assert!((corner[0].as_f64().unwrap() - 11.576).abs() < 1e-10, "{told}");
        assert!((corner[1].as_f64().unwrap() - 48.138).abs() < 1e-10, "{told}");
        let mut metres = told.clone();
        Coordinates::Metres.read(&mut metres, None).unwrap();
        assert_eq!(metres, told);
    }

    #[test]
    fn what_is_no_place_on_the_earth_is_named() {
        let mut metres = square([-200.0, -50.0], [50.0, 50.0]);
        let error = Coordinates::Degrees.read(&mut metres, Some(&axes())).unwrap_err();
        assert!(error.to_string().contains("longitude"), "{error}");
        let mut degrees = square([11.575, 48.137], [11.576, 48.138]);
        let error = Coordinates::Degrees.read(&mut degrees, None).unwrap_err();
        assert!(error.to_string().contains("[world] origin"), "{error}");
        // Metres that could be degrees lie on another continent.
        let mut metres = square([-50.0, -50.0], [50.0, 50.0]);
        Coordinates::Degrees.read(&mut metres, Some(&axes())).unwrap();
        assert!(parse(&metres).is_err());
    }
}
