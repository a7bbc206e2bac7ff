//! Positions of the last hour, one moment a second, for `/v1/history`.

use std::collections::VecDeque;
use std::sync::Arc;

use jiff::Timestamp;
use serde::{Serialize, Serializer};

use crate::geo::Geodetic;
use crate::monitor::{GeodeticFields, PositionStatus, Report};

/// Moments kept, and the time between two of them: an hour of trails.
const MOMENTS_KEPT: usize = 3600;
const STEP_MS: i64 = 1000;
/// Beams kept of one moment; a field of false detections must not fill the memory.
const BEAMS_KEPT: usize = 64;

/// Where the beams were, thinned to one moment a second: trails that survive a reload of the page.
#[derive(Debug, Default)]
pub struct History {
    moments: VecDeque<Moment>,
}

/// The beams at one time.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Moment {
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    pub frame: u64,
    pub emitters: Vec<PastBeam>,
}

/// One beam in the past.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct PastBeam {
    pub track: u64,
    /// Metres, to the centimetre.
    pub x_m: f32,
    pub y_m: f32,
    /// The same on the earth, where `[world] origin` places it.
    #[serde(flatten)]
    #[schema(value_type = GeodeticFields)]
    pub geodetic: Option<Geodetic>,
    pub status: PositionStatus,
    /// One name for all moments.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "name")]
    #[schema(value_type = Option<String>)]
    pub user: Option<Arc<str>>,
}

fn name<S: Serializer>(user: &Option<Arc<str>>, serializer: S) -> Result<S::Ok, S::Error> {
    user.as_deref().serialize(serializer)
}

impl History {
    pub fn new() -> Self {
        Self::default()
    }

    /// Keeps a report if a step has passed since the last one kept. Time that runs backwards (a looped
    /// recording, a clock that was set) starts the history anew.
    pub fn record(&mut self, report: &Report) {
        if let Some(last) = self.moments.back() {
            let passed = report.time.as_millisecond() - last.time.as_millisecond();
            if passed < 0 {
                self.moments.clear();
            } else if passed < STEP_MS {
                return;
            }
        }
        if self.moments.len() == MOMENTS_KEPT {
            self.moments.pop_front();
        }
        let centimetres = |x: f64| ((x * 100.0).round() / 100.0) as f32;
        let known = self.moments.back().map_or(&[][..], |last| &last.emitters);
        let shared = |user: &str| {
            let mut names = known.iter().filter_map(|beam| beam.user.as_ref());
            names
                .find(|name| &***name == user)
                .cloned()
                .unwrap_or_else(|| user.into())
        };
        let past = report.emitters.iter().take(BEAMS_KEPT).map(|e| PastBeam {
            track: e.track,
            x_m: centimetres(e.x_m),
            y_m: centimetres(e.y_m),
            geodetic: e.geodetic,
            status: e.status,
            user: e.user.as_deref().map(shared),
        });
        let moment = Moment {
            time: report.time,
            frame: report.frame,
            emitters: past.collect(),
        };
        self.moments.push_back(moment);
    }

    /// The last `limit` moments after `since`, oldest first.
    pub fn after(&self, since: Option<Timestamp>, limit: usize) -> Vec<Moment> {
        let first = since.map_or(0, |t| self.moments.partition_point(|m| m.time <= t));
        let first = first.max(self.moments.len().saturating_sub(limit));
        self.moments.range(first..).cloned().collect()
    }
}
