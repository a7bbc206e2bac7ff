//! Zones and known lights that an operator has set before a story begins.

use crate::monitor::zones::{self, Zone, ZoneKind};
use crate::monitor::{AlertEvent, KnownLight, KnownLightConfig, Monitor, known_lights_of};

/// Known lights of 2 m radius.
pub fn known(places: &[[f64; 2]]) -> Vec<KnownLight> {
    let config = |[x_m, y_m]: &[f64; 2]| KnownLightConfig {
        x_m: *x_m,
        y_m: *y_m,
        radius_m: Some(2.0),
        note: None,
        until: None,
    };
    let configs: Vec<_> = places.iter().map(config).collect();
    known_lights_of(&configs).expect("places within the view")
}

type Operator = Box<dyn Fn(f64, &mut Monitor, &[AlertEvent])>;

/// A zone with nothing but its corners, east and north, m.
pub fn zone(name: &str, kind: ZoneKind, corners: Vec<[f64; 2]>) -> Vec<Zone> {
    let config = zones::Config {
        name: name.to_owned(),
        kind,
        polygon: Some(corners),
        geojson: None,
        coordinates: zones::Coordinates::Metres,
        users: Vec::new(),
        tolerated_distance_m: None,
        severity: None,
        webhooks: None,
    };
    zones::load(&[config], None).expect("a simple polygon")
}

/// Puts these in force before the first frame.
pub fn in_force(zones: Vec<Zone>, lights: Vec<KnownLight>) -> Operator {
    Box::new(move |t, monitor, _| {
        if t == 0.0 {
            let put = monitor.set_fixed(zones.clone(), lights.clone(), Vec::new());
            put.expect("a thousand zones at most");
        }
    })
}
