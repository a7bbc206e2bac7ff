use std::collections::VecDeque;

use jiff::Timestamp;
use serde_json::{Value, json};

use crate::claims::seconds;
use crate::estimate::Estimate;
use crate::monitor::report::Observation;

/// Share of saturated pixels from which a frame is evidence of nothing. Nine users' spots, four σ wide at σ_eff = 1 mm, cover an
/// eighth of the paper's sensor; a lamp that covers a quarter hides whoever wants to be hidden.
pub const BLINDING_SHARE: f64 = 0.25;
/// Exact repeats are looked for among this many frames.
const REMEMBERED: usize = 8;

/// Whether the sensor sees. A frame without information is no evidence of anything, least of all of absence.
#[derive(Debug, Default)]
pub struct SensorHealth {
    digests: VecDeque<u64>,
    last_usable: Option<Timestamp>,
    started: Option<Timestamp>,
    blind: Option<SensorFault>,
    blind_frames: u64,
}

/// Why a frame carries no information.
#[derive(Clone, Debug, PartialEq)]
pub enum SensorFault {
    NoFrame,
    Unusable(String),
    Saturated(f64),
    Repeated,
    /// Every user's beam went out in the same frame.
    AllDark(usize),
}

impl SensorHealth {
    /// The estimate if the frame can be believed. `lit` is how many active users were seen a moment ago.
    pub fn judge<'a>(&mut self, seen: &Observation<'a>, lit: usize) -> Option<&'a Estimate> {
        self.started.get_or_insert(seen.time);
        let blind = match seen.result {
            Err(error) => Some(SensorFault::Unusable(error.to_string())),
            Ok(_) if self.digests.contains(&seen.digest) => Some(SensorFault::Repeated),
            Ok(e) if e.saturated_share >= BLINDING_SHARE => Some(SensorFault::Saturated(e.saturated_share)),
            Ok(e) if e.emitters.is_empty() && lit >= 2 => Some(SensorFault::AllDark(lit)),
            Ok(_) => None,
        };
        if self.digests.len() == REMEMBERED {
            self.digests.pop_front();
        }
        self.digests.push_back(seen.digest);
        if blind.is_some() {
            self.blind = blind;
            self.blind_frames += 1;
            return None;
        }
        self.blind = None;
        self.blind_frames = 0;
        self.last_usable = Some(seen.time);
        seen.result.ok()
    }

    /// A frame came to harm on its way.
    pub fn unusable(&mut self, time: Timestamp, reason: &str) {
        self.started.get_or_insert(time);
        self.blind = Some(SensorFault::Unusable(reason.to_owned()));
        self.blind_frames += 1;
    }

    /// Nothing came.
    pub fn nothing(&mut self, now: Timestamp) {
        self.started.get_or_insert(now);
        self.blind.get_or_insert(SensorFault::NoFrame);
    }

    /// Seconds since a frame could be believed.
    pub fn blind_s(&self, now: Timestamp) -> f64 {
        let since = self.last_usable.or(self.started).unwrap_or(now);
        if self.blind.is_some() { seconds(since, now) } else { 0.0 }
    }

    pub fn evidence(&self, now: Timestamp) -> Value {
        let (reason, detail) = match &self.blind {
            None | Some(SensorFault::NoFrame) => ("no_frame", Value::Null),
            Some(SensorFault::Unusable(error)) => ("unusable", json!(error)),
            Some(SensorFault::Saturated(share)) => ("saturated", json!({ "share": share })),
            Some(SensorFault::Repeated) => ("frozen", Value::Null),
            Some(SensorFault::AllDark(users)) => ("all_beams_lost", json!({ "users": users })),
        };
        json!({
            "reason": reason,
            "detail": detail,
            "last_usable": self.last_usable,
            "unusable_frames": self.blind_frames,
            "blind_s": self.blind_s(now),
        })
    }
}
