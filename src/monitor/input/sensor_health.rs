//! Whether the sensor sees. A frame without information is evidence of nothing, least of all of absence.

use std::collections::VecDeque;

use jiff::Timestamp;
use serde_json::{Value, json};

use crate::estimate::Estimate;
use crate::monitor::report::Observation;
use crate::time::seconds;

/// Share of saturated pixels from which a frame is evidence of nothing. Nine users' spots, four σ wide at σ_eff = 1 mm, cover an
/// eighth of the paper's sensor; a lamp that covers a quarter hides whoever wants to be hidden.
pub const BLINDING_SHARE: f64 = 0.25;
/// Frames among which exact repeats are looked for. No two noisy frames agree in every pixel, so that more would cost nothing but
/// comparisons. Not tuned.
const REMEMBERED_FRAMES: usize = 8;
/// Frames in a row that each have another exposure than the one before, from which short and long ones are taken in turns: a control
/// that follows a beam changes it every other frame at most.
const TURNS: u32 = 4;
/// Users who were seen a moment ago, from which on a frame without any beam is blind and not empty. With one, a user who switches
/// off would be a lost sensor; with more, a capped lens would be users unseen.
const MIN_VISIBLE_USERS: usize = 2;

/// The newest usable frame, and why those after it were not.
#[derive(Debug, Default)]
pub struct SensorHealth {
    digests: VecDeque<u64>,
    last_usable: Option<Timestamp>,
    started: Option<Timestamp>,
    fault: Option<Fault>,
    unusable_frames: u64,
    energy_scale: f64,
    exposures_changed: u32,
}

/// Why a frame carries no information.
#[derive(Clone, Debug, PartialEq)]
enum Fault {
    NoFrame,
    Unusable(String),
    Saturated(f64),
    Repeated,
    /// Every user's beam went out in the same frame.
    AllDark(usize),
}

impl SensorHealth {
    /// The estimate if the frame carries information. `visible_users`: active users seen a moment ago.
    pub fn usable_estimate<'a>(&mut self, seen: &Observation<'a>, visible_users: usize) -> Option<&'a Estimate> {
        self.started.get_or_insert(seen.time);
        let is_changed = std::mem::replace(&mut self.energy_scale, seen.energy_scale) != seen.energy_scale;
        self.exposures_changed = if is_changed {
            self.exposures_changed.saturating_add(1)
        } else {
            0
        };
        let fault = match seen.result {
            Err(error) => Some(Fault::Unusable(error.to_string())),
            Ok(_) if self.digests.contains(&seen.digest) => Some(Fault::Repeated),
            Ok(e) if e.saturated_share >= BLINDING_SHARE => Some(Fault::Saturated(e.saturated_share)),
            Ok(e) if e.emitters.is_empty() && visible_users >= MIN_VISIBLE_USERS => Some(Fault::AllDark(visible_users)),
            Ok(_) => None,
        };
        if self.digests.len() == REMEMBERED_FRAMES {
            self.digests.pop_front();
        }
        self.digests.push_back(seen.digest);
        if fault.is_some() {
            self.fault = fault;
            self.unusable_frames += 1;
            return None;
        }
        self.fault = None;
        self.unusable_frames = 0;
        self.last_usable = Some(seen.time);
        seen.result.ok()
    }

    /// The source could not deliver a frame whole.
    pub fn unusable(&mut self, time: Timestamp, reason: &str) {
        self.started.get_or_insert(time);
        self.fault = Some(Fault::Unusable(reason.to_owned()));
        self.unusable_frames += 1;
    }

    /// No frame has come by `now`.
    pub fn no_frame(&mut self, now: Timestamp) {
        self.started.get_or_insert(now);
        self.fault.get_or_insert(Fault::NoFrame);
    }

    /// Whether short and long exposures are taken in turns, as beside a beam that dazzles.
    pub fn is_alternating(&self) -> bool {
        self.exposures_changed >= TURNS
    }

    /// Seconds since the last usable frame; zero while the newest frame is one.
    pub fn blind_s(&self, now: Timestamp) -> f64 {
        let since = self.last_usable.or(self.started).unwrap_or(now);
        if self.fault.is_some() { seconds(since, now) } else { 0.0 }
    }

    /// What an alert says of the fault.
    pub fn evidence(&self, now: Timestamp) -> Value {
        let (reason, detail) = match &self.fault {
            None | Some(Fault::NoFrame) => ("no_frame", Value::Null),
            Some(Fault::Unusable(error)) => ("unusable", json!(error)),
            Some(Fault::Saturated(share)) => ("saturated", json!({ "share": share })),
            Some(Fault::Repeated) => ("frozen", Value::Null),
            Some(Fault::AllDark(users)) => ("all_beams_lost", json!({ "users": users })),
        };
        json!({
            "reason": reason,
            "detail": detail,
            "last_usable": self.last_usable,
            "unusable_frames": self.unusable_frames,
            "blind_s": self.blind_s(now),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::Error;

    fn at(s: i64) -> Timestamp {
        Timestamp::from_second(s).unwrap()
    }

    /// What a frame of these pixels, saturated by `share` and without any beam, is taken for.
    fn see(health: &mut SensorHealth, s: i64, digest: u64, share: f64, visible_users: usize) -> bool {
        let estimate = Estimate {
            saturated_share: share,
            ..Estimate::default()
        };
        let seen = Observation {
            frame: 0,
            time: at(s),
            result: Ok(&estimate),
            energy_scale: 1.0,
            digest,
            look: crate::monitor::Look::Level,
        };
        health.usable_estimate(&seen, visible_users).is_some()
    }

    fn reason(health: &SensorHealth) -> Value {
        health.evidence(at(9))["reason"].clone()
    }

    #[test]
    fn an_exact_repeat_among_eight_frames_is_a_frozen_sensor() {
        let mut health = SensorHealth::default();
        for digest in 0..8 {
            assert!(see(&mut health, 0, digest, 0.0, 0));
        }
        assert!(!see(&mut health, 1, 0, 0.0, 0));
        assert_eq!(reason(&health), "frozen");
        // The repeat took the place of the oldest: 1 is gone by the next but one.
        assert!(see(&mut health, 2, 8, 0.0, 0));
        assert!(see(&mut health, 2, 1, 0.0, 0));
    }

    #[test]
    fn exposures_that_change_from_frame_to_frame_are_a_pair() {
        let mut health = SensorHealth::default();
        let estimate = Estimate::default();
        let mut is_alternating_after = |scales: &[f64]| {
            for (energy_scale, digest) in scales.iter().zip(0..) {
                let seen = Observation {
                    frame: 0,
                    time: at(0),
                    result: Ok(&estimate),
                    energy_scale: *energy_scale,
                    digest,
                    look: crate::monitor::Look::Level,
                };
                health.usable_estimate(&seen, 0);
            }
            health.is_alternating()
        };
        assert!(
            !is_alternating_after(&[1.0, 1.0, 2.0, 2.0, 4.0, 4.0]),
            "one that follows a beam"
        );
        assert!(is_alternating_after(&[1.0, 8.0, 1.0, 8.0]));
        assert!(!is_alternating_after(&[8.0]));
    }

    #[test]
    fn a_quarter_of_saturated_pixels_blinds() {
        let mut health = SensorHealth::default();
        assert!(see(&mut health, 0, 1, 0.2499, 0));
        assert!(!see(&mut health, 1, 2, 0.25, 0));
        assert_eq!(reason(&health), "saturated");
    }

    #[test]
    fn all_beams_gone_at_once_is_the_sensor_and_one_is_the_user() {
        let mut health = SensorHealth::default();
        assert!(see(&mut health, 0, 1, 0.0, 1));
        assert!(!see(&mut health, 1, 2, 0.0, 2));
        assert_eq!(reason(&health), "all_beams_lost");
    }

    #[test]
    fn blindness_counts_from_the_last_usable_frame_or_the_start() {
        let mut health = SensorHealth::default();
        health.no_frame(at(3));
        assert_eq!(health.blind_s(at(5)), 2.0);
        assert_eq!(reason(&health), "no_frame");
        assert!(see(&mut health, 6, 1, 0.0, 0));
        assert_eq!(health.blind_s(at(8)), 0.0);
        health.unusable(at(7), "half a frame");
        assert_eq!(health.blind_s(at(9)), 3.0);
        assert_eq!(health.evidence(at(9))["detail"], "half a frame");
        let error = Error::NoUsablePixel {
            total: 4,
            nan: 4,
            saturated: 0,
            masked: 0,
        };
        let seen = Observation {
            frame: 0,
            time: at(8),
            result: Err(&error),
            energy_scale: 1.0,
            digest: 5,
            look: crate::monitor::Look::Level,
        };
        assert!(health.usable_estimate(&seen, 0).is_none());
        assert_eq!(health.evidence(at(9))["unusable_frames"], 2);
    }
}
