//! Zones as GeoJSON (RFC 7946): a feature for each, its keys in `properties`. Coordinates are metres east and north here.

use serde_json::{Value, json};

use super::check::{ZoneError, check_all, checked, shape_error};
use super::shape::Shape;
use super::zone::{MAX_ZONES, Zone, ZoneKind};
use crate::monitor::alert::Severity;

/// Keys of a feature's `properties`.
const KEYS: [&str; 8] = [
    "name",
    "kind",
    "users",
    "tolerated_distance_m",
    "severity",
    "webhooks",
    "source",
    "area_m2",
];

/// Zones as a feature collection.
pub fn collection<'a>(zones: impl Iterator<Item = &'a Zone>) -> Value {
    json!({ "type": "FeatureCollection", "features": zones.map(feature).collect::<Vec<_>>() })
}

fn feature(zone: &Zone) -> Value {
    let mut polygons = zone.shape.closed_rings();
    let geometry = match polygons.len() {
        1 => json!({ "type": "Polygon", "coordinates": polygons.remove(0) }),
        _ => json!({ "type": "MultiPolygon", "coordinates": polygons }),
    };
    let mut properties = json!({
        "name": zone.name,
        "kind": zone.kind,
        "source": if zone.is_fixed { "config" } else { "api" },
        "area_m2": zone.shape.area_m2(),
    });
    if !zone.users.is_empty() {
        properties["users"] = json!(zone.users);
    }
    for (key, value) in [
        ("tolerated_distance_m", json!(zone.tolerated_distance_m)),
        ("severity", json!(zone.severity)),
        ("webhooks", json!(zone.webhooks)),
    ] {
        if !value.is_null() {
            properties[key] = value;
        }
    }
    json!({ "type": "Feature", "id": zone.name, "properties": properties, "geometry": geometry })
}

/// The zones of a feature collection, without those that it marks as the config's (`"source": "config"`).
pub fn parse(value: &Value) -> Result<Vec<Zone>, ZoneError> {
    expect_type(value, "FeatureCollection", "type")?;
    let features = value["features"].as_array().ok_or_else(|| {
        ZoneError::new(
            "features",
            format!("expected a list, found {}", shown(&value["features"])),
        )
    })?;
    if features.len() > MAX_ZONES {
        let reason = format!("expected at most {MAX_ZONES}, found {}", features.len());
        return Err(ZoneError::new("features", reason));
    }
    let mut zones = Vec::new();
    for (k, feature) in features.iter().enumerate() {
        if feature["properties"]["source"] == "config" {
            continue;
        }
        zones.push(zone(feature, k)?);
    }
    check_all(&zones)?;
    Ok(zones)
}

fn zone(feature: &Value, k: usize) -> Result<Zone, ZoneError> {
    let of_feature = |key: &str| format!("features[{k}].{key}");
    let place = |key: &str| format!("features[{k}].properties.{key}");
    expect_type(feature, "Feature", &of_feature("type"))?;
    let properties = feature["properties"].as_object().ok_or_else(|| {
        ZoneError::new(
            of_feature("properties"),
            format!(
                "expected an object with name and kind, found {}",
                shown(&feature["properties"])
            ),
        )
    })?;
    if let Some(key) = properties.keys().find(|key| !KEYS.contains(&key.as_str())) {
        let reason = format!("unknown key; expected one of {}", KEYS[..6].join(", "));
        return Err(ZoneError::new(place(&key.chars().take(64).collect::<String>()), reason));
    }
    let get = |key: &str| properties.get(key).filter(|v| !v.is_null());
    let fault = |key: &str, expected: &str| {
        let found = get(key).map_or("nothing".to_owned(), shown);
        ZoneError::new(place(key), format!("expected {expected}, found {found}"))
    };
    let words = |key: &str| match get(key) {
        None => Ok(None),
        Some(list) => serde_json::from_value::<Vec<String>>(list.clone())
            .map(Some)
            .map_err(|_| fault(key, "a list of names")),
    };
    let zone = Zone {
        name: get("name")
            .and_then(Value::as_str)
            .ok_or_else(|| fault("name", "a text"))?
            .to_owned(),
        kind: get("kind")
            .and_then(|v| serde_json::from_value::<ZoneKind>(v.clone()).ok())
            .ok_or_else(|| fault("kind", "\"ignore\", \"restricted\" or \"watch\""))?,
        shape: shape(&feature["geometry"], &of_feature("geometry"))?,
        users: words("users")?.unwrap_or_default(),
        tolerated_distance_m: match get("tolerated_distance_m") {
            None => None,
            Some(v) => Some(v.as_f64().ok_or_else(|| fault("tolerated_distance_m", "a number"))?),
        },
        severity: match get("severity") {
            None => None,
            Some(v) => Some(
                serde_json::from_value::<Severity>(v.clone())
                    .map_err(|_| fault("severity", "\"info\", \"warning\" or \"critical\""))?,
            ),
        },
        webhooks: words("webhooks")?,
        is_fixed: false,
    };
    checked(zone, &place)
}

/// All polygons of a geometry, a feature or a collection.
pub(super) fn shape_of_all(value: &Value) -> Result<Shape, ZoneError> {
    let mut polygons = Vec::new();
    match value["type"].as_str() {
        Some("FeatureCollection") => {
            for (k, feature) in value["features"].as_array().into_iter().flatten().enumerate() {
                polygons.extend(rings(&feature["geometry"], &format!("features[{k}].geometry"))?);
            }
        }
        Some("Feature") => polygons = rings(&value["geometry"], "geometry")?,
        _ => polygons = rings(value, "geometry")?,
    }
    Shape::new(polygons).map_err(|e| shape_error(&e, "coordinates"))
}

fn shape(geometry: &Value, place: &str) -> Result<Shape, ZoneError> {
    Shape::new(rings(geometry, place)?).map_err(|e| shape_error(&e, &format!("{place}.coordinates")))
}

type Rings = Vec<Vec<[f64; 2]>>;

/// The polygons of a geometry.
fn rings(geometry: &Value, place: &str) -> Result<Vec<Rings>, ZoneError> {
    let coordinates = &geometry["coordinates"];
    // A third coordinate, the height, is allowed and not used.
    let corner = |v: &Value| -> Option<[f64; 2]> {
        let list = v.as_array().filter(|l| (2..=3).contains(&l.len()))?;
        Some([list[0].as_f64()?, list[1].as_f64()?])
    };
    let ring = |v: &Value| v.as_array()?.iter().map(corner).collect::<Option<Vec<_>>>();
    let polygon = |v: &Value| v.as_array()?.iter().map(ring).collect::<Option<Rings>>();
    let polygons = match geometry["type"].as_str() {
        Some("Polygon") => polygon(coordinates).map(|p| vec![p]),
        Some("MultiPolygon") => coordinates.as_array().and_then(|l| l.iter().map(polygon).collect()),
        _ => {
            let reason = format!("expected a Polygon or MultiPolygon, found {}", shown(&geometry["type"]));
            return Err(ZoneError::new(place, reason));
        }
    };
    polygons.ok_or_else(|| {
        ZoneError::new(
            format!("{place}.coordinates"),
            "expected lists of rings of corners [x, y], found something else",
        )
    })
}

fn expect_type(value: &Value, expected: &str, place: &str) -> Result<(), ZoneError> {
    match value["type"].as_str() == Some(expected) {
        true => Ok(()),
        false => Err(ZoneError::new(
            place,
            format!("expected {expected:?}, found {}", shown(&value["type"])),
        )),
    }
}

/// A value as a message has it, not longer than a line.
fn shown(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(60) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(name: &str) -> Value {
        json!({
            "type": "Feature",
            "properties": { "name": name, "kind": "restricted", "users": ["u-1"] },
            "geometry": { "type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]] },
        })
    }

    fn collected(features: Vec<Value>) -> Value {
        json!({ "type": "FeatureCollection", "features": features })
    }

    #[test]
    fn zones_survive_the_way_there_and_back() {
        let mut two = square("b");
        two["properties"] = json!({ "name": "b", "kind": "watch", "severity": "critical", "webhooks": [], "tolerated_distance_m": 2.5 });
        two["geometry"] = json!({ "type": "MultiPolygon", "coordinates": [
            [[[20, 0], [29, 0], [29, 9], [20, 0]]],
            [[[40, 0, 3], [49, 0, 3], [49, 9, 3], [40, 0, 3]]],
        ] });
        let zones = parse(&collected(vec![square("a"), two])).unwrap();
        assert_eq!(parse(&collection(zones.iter())).unwrap(), zones);
        assert_eq!(shape_of_all(&collection(zones.iter())).unwrap().area_m2(), 162.0);
    }

    #[test]
    fn those_of_the_config_are_left_out() {
        let mut fixed = square("a");
        fixed["properties"]["source"] = json!("config");
        assert_eq!(parse(&collected(vec![fixed, square("b")])).unwrap().len(), 1);
    }

    #[test]
    fn every_refusal_names_its_place() {
        let with = |change: &dyn Fn(&mut Value)| {
            let mut feature = square("a");
            change(&mut feature);
            parse(&collected(vec![feature])).unwrap_err().to_string()
        };
        for (found, expected) in [
            (
                parse(&json!(3)).unwrap_err().to_string(),
                "type: expected \"FeatureCollection\", found null",
            ),
            (
                parse(&json!({"type": "FeatureCollection"})).unwrap_err().to_string(),
                "features: expected a list",
            ),
            (
                with(&|f| f["properties"]["kind"] = json!("odd")),
                "features[0].properties.kind: expected \"ignore\"",
            ),
            (
                with(&|f| f["properties"]["name"] = json!("")),
                "features[0].properties.name: expected 1 to 64",
            ),
            (
                with(&|f| f["properties"]["colour"] = json!("red")),
                "features[0].properties.colour: unknown key",
            ),
            (
                with(&|f| f["geometry"]["type"] = json!("Point")),
                "features[0].geometry: expected a Polygon",
            ),
            (
                with(&|f| f["geometry"]["coordinates"] = json!([[["x"]]])),
                "features[0].geometry.coordinates: expected",
            ),
            (
                with(&|f| f["geometry"]["coordinates"] = json!([])),
                "features[0].geometry.coordinates: expected a polygon",
            ),
            (
                with(&|f| f["geometry"]["coordinates"] = json!([[[0, 0], [9, 9], [9, 0], [0, 6]]])),
                "features[0].geometry.coordinates: expected edges that do not cross",
            ),
            (
                with(&|f| f["properties"]["severity"] = json!("info")),
                "features[0].properties.severity: expected in",
            ),
            (
                parse(&collected(vec![square("a"), square("a")]))
                    .unwrap_err()
                    .to_string(),
                "zone.name: expected a name that no other zone has",
            ),
            (
                parse(&collected(vec![square("a"); 1001])).unwrap_err().to_string(),
                "features: expected at most 1000",
            ),
        ] {
            assert!(found.starts_with(expected), "{found}");
        }
    }
}
