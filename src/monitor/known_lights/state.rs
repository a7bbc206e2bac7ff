//! One known light: what was learned of it, its track, and what the API shows of both.

use jiff::Timestamp;
use nalgebra::Vector2;
use serde::Serialize;

use super::light::{KnownLight, RADIUS_M};
use super::range::LightRange;

/// A known light and its track.
#[derive(Debug)]
pub(in crate::monitor) struct LightState {
    pub light: KnownLight,
    /// Where the frame shows it, our own pose error included, m.
    pub expected: Vector2<f64>,
    pub range: LightRange,
    /// The track that was associated last.
    pub track: Option<u64>,
    /// Associated in the newest frame.
    pub is_seen: bool,
    pub last_seen: Option<Timestamp>,
    pub gone_since: Option<Timestamp>,
    /// It went out, and the track is a beam that came on elsewhere.
    pub is_displaced: bool,
    /// Since when there is evidence of a change.
    pub suspected_since: Option<Timestamp>,
}

/// A known light as the API shows it.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct KnownLightStatus {
    #[serde(flatten)]
    pub light: KnownLight,
    /// Whether the newest frame shows it.
    pub is_seen: bool,
    /// The track that follows it.
    pub track: Option<u64>,
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_seen: Option<Timestamp>,
    /// Share of its light that a second beam in its spot may have and raise no alert.
    pub unseen_share: f64,
    /// Area on the ground within which a beam that replaces it may be, m².
    pub unseen_area_m2: f64,
}

impl LightState {
    pub fn new(light: KnownLight) -> Self {
        Self {
            expected: Vector2::new(light.x_m, light.y_m),
            range: light
                .learned
                .clone()
                .map_or_else(LightRange::default, LightRange::remembered),
            track: None,
            is_seen: false,
            last_seen: None,
            gone_since: None,
            is_displaced: false,
            suspected_since: None,
            light,
        }
    }

    /// The radius follows from what is learned, unless it was stated.
    pub fn take_learned(&mut self) {
        self.light.learned = self.range.learned().cloned();
        if let Some((_, reach_m)) = self.range.place().filter(|_| !self.light.is_radius_stated) {
            self.light.radius_m = reach_m.max(0.5).min(*RADIUS_M.end());
        }
    }

    /// The frame shows it as this track.
    pub fn found(&mut self, track: u64, now: Timestamp) {
        if self.track != Some(track) {
            self.is_displaced = false;
        }
        self.track = Some(track);
        self.is_seen = true;
        self.last_seen = Some(now);
        self.gone_since = None;
    }
}
