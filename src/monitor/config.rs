//! `[monitor]`: what the operator sets; and the source of the frames.

use serde::{Deserialize, Serialize};

/// `[monitor]`: what the operator understands, from which the statistical tests are derived.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A user this far from the claim is still where they say.
    pub tolerated_distance_m: f64,
    /// Largest offset of the log's clock from ours, either way, that is estimated from moving users and corrected.
    pub tolerated_clock_offset_s: f64,
    /// Factor by which a user's light may grow for good before the rest counts as a second beam in the same spot.
    pub tolerated_brightening: f64,
    /// Tolerated false alerts per month of continuous watching, all kinds together.
    pub false_alerts_per_month: f64,
    /// Seconds from the first detection of a beam nobody claims to its alert. Claims must arrive within 0.65 of it.
    pub decision_s: f64,
    /// Seconds without a usable frame before the sensor counts as lost.
    pub sensor_lost_s: f64,
    /// Seconds without a new claim before the log counts as quiet; never below five claim periods.
    pub claims_stale_s: f64,
    /// Seconds a beam may stay on after its user's claim says "ended".
    pub ended_grace_s: f64,
    /// A common shift of all users up to this is corrected; a larger one is an alert. Half the tolerated distance when
    /// left out.
    pub pose_limit_m: Option<f64>,
    /// Longest absence, s, for which an alert whose cause comes and goes is held open.
    pub cool_down_s: f64,
}

/// Why a `[monitor]` table cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("monitor.{field}: expected {expected}, found {found}")]
pub struct ConfigError {
    pub field: &'static str,
    pub expected: &'static str,
    pub found: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            tolerated_distance_m: 5.0,
            tolerated_clock_offset_s: 1.0,
            tolerated_brightening: 1.35,
            false_alerts_per_month: 1.0,
            decision_s: 1.0,
            sensor_lost_s: 1.0,
            claims_stale_s: 5.0,
            ended_grace_s: 3.0,
            pose_limit_m: None,
            cool_down_s: 60.0,
        }
    }
}

impl Config {
    /// Checks every number.
    pub fn validate(&self) -> Result<(), ConfigError> {
        const DISTANCE: &str = "0.001 to 100000 (metres; no camera sees farther)";
        const SECONDS: &str = "0.001 to 3600 (seconds; what is reported an hour later comes too late)";
        let ranges = [
            ("tolerated_distance_m", self.tolerated_distance_m, 1e-3..=1e5, DISTANCE),
            ("pose_limit_m", self.pose_limit_m.unwrap_or(1.0), 1e-3..=1e5, DISTANCE),
            ("decision_s", self.decision_s, 1e-3..=3600.0, SECONDS),
            ("sensor_lost_s", self.sensor_lost_s, 1e-3..=3600.0, SECONDS),
            ("ended_grace_s", self.ended_grace_s, 1e-3..=3600.0, SECONDS),
            (
                "tolerated_clock_offset_s",
                self.tolerated_clock_offset_s,
                1e-3..=3600.0,
                "0.001 to 3600 (seconds; a larger offset is for claims.clock_offset_s)",
            ),
            (
                "claims_stale_s",
                self.claims_stale_s,
                1e-3..=86_400.0,
                "0.001 to 86400 (seconds; a log that is silent for a day is stale)",
            ),
            (
                "cool_down_s",
                self.cool_down_s,
                1e-3..=86_400.0,
                "0.001 to 86400 (seconds; an alert that never clears hides the next one)",
            ),
            (
                "false_alerts_per_month",
                self.false_alerts_per_month,
                1e-6..=1e6,
                "1e-6 to 1e6 (from one in 80000 years to one every three seconds)",
            ),
            (
                "tolerated_brightening",
                self.tolerated_brightening,
                1.0..=100.0,
                "a factor of 1 to 100 (more would hide any second emitter in the spot)",
            ),
        ];
        for (field, found, range, expected) in ranges {
            if !range.contains(&found) {
                return Err(ConfigError { field, expected, found });
            }
        }
        Ok(())
    }
}

/// Where the frames come from, as alerts name it.
#[derive(Clone, Debug)]
pub struct Source {
    /// "simulator", "v4l2" or "replay".
    pub kind: String,
    /// The recording, where there is one.
    pub file: Option<String>,
    /// Frames per second, from which thresholds follow.
    pub rate_hz: f64,
}
