//! What places mean to a frame: their height, where they are on the earth, and the zones that they are in.

use nalgebra::{Vector2, Vector3};
use serde_json::Value;

use super::finding::Content;
use super::frame_context::FrameContext;
use super::track::beam_track::Track;
use super::zones::{Zone, ZoneKind};
use crate::geo::Geodetic;

/// Standard deviations of a position within which it may be inside of an ignored zone: who stands at the edge must not flicker. More
/// widen the ground on which a stranger is ignored by as much.
const EDGE: f64 = 3.0;

impl FrameContext {
    /// A track's place in the world, m, with the height of the ground where its beam meets it.
    pub fn place(&self, track: &Track) -> Vector3<f64> {
        let here = self.position(track);
        Vector3::new(here.x, here.y, track.detection.z_m)
    }

    /// A place of the world on the earth, where the world has an origin.
    pub fn geodetic(&self, place: Vector3<f64>) -> Option<Geodetic> {
        self.axes.map(|axes| axes.to_geodetic(place.into()))
    }

    /// The restricted zone that a track is in.
    pub fn restricted_zone(&self, track: &Track) -> Option<&Zone> {
        if self.zones.is_empty() {
            return None;
        }
        self.zones.within(self.world(track), ZoneKind::Restricted, 0.0)
    }

    /// The zone in which a beam that nobody claims raises nothing: by its errors it may be inside. A restricted zone goes before.
    pub fn ignore_zone(&self, track: &Track) -> Option<&Zone> {
        if self.zones.is_empty() {
            return None;
        }
        let (here, error_m) = (self.world(track), self.position_error_m(track));
        let ignored = self.zones.within(here, ZoneKind::Ignore, -EDGE * error_m)?;
        self.zones
            .within(here, ZoneKind::Restricted, 0.0)
            .is_none()
            .then_some(ignored)
    }

    /// Distance within which the user of a claim at `p` is where they say, m.
    pub fn tolerated_distance_m(&self, p: Vector2<f64>) -> f64 {
        if self.zones.is_empty() {
            return self.config.tolerated_distance_m;
        }
        let watched = self
            .zones
            .near(self.unmoved(p), 0.0, |zone| zone.kind == ZoneKind::Watch);
        let own = watched.filter_map(|i| i.zone.tolerated_distance_m);
        own.reduce(f64::min).unwrap_or(self.config.tolerated_distance_m)
    }

    /// Adds to an alert where on the earth it is, and what its zone and the maintenance in force say.
    pub fn mark(&self, content: &mut Content) {
        if let (Some(x), Some(y), Some(z)) = (content.x_m, content.y_m, content.z_m) {
            content.geodetic = self.geodetic(Vector3::new(x, y, z));
        }
        if self.sensor.is_alternating()
            && let Value::Object(evidence) = &mut content.evidence
        {
            evidence.insert("exposures".into(), "alternating".into());
        }
        content.maintenance = self.maintenance.in_force(self.now).map(|window| window.id.clone());
        if content.maintenance.is_some() {
            content.webhooks = Some(Vec::new());
        }
        let Some((x, y)) = content.x_m.zip(content.y_m).filter(|_| !self.zones.is_empty()) else {
            return;
        };
        // What lasts of a moving platform's pose error is out of the alert's place already.
        let place = Vector2::new(x, y);
        let here = (place - self.pose.displacement().at(place)).into();
        let of = |kind| self.zones.within(here, kind, 0.0);
        let Some(zone) = of(ZoneKind::Restricted).or_else(|| of(ZoneKind::Watch)) else {
            return;
        };
        content.zone = Some(zone.name.clone());
        content.severity = zone.severity.unwrap_or(content.severity);
        if content.webhooks.is_none() {
            content.webhooks = zone.webhooks.clone();
        }
    }
}
