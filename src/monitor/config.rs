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
        const POSITIVE: &str = "a positive finite number";
        let positive = [
            ("tolerated_distance_m", self.tolerated_distance_m),
            ("tolerated_clock_offset_s", self.tolerated_clock_offset_s),
            ("false_alerts_per_month", self.false_alerts_per_month),
            ("decision_s", self.decision_s),
            ("sensor_lost_s", self.sensor_lost_s),
            ("claims_stale_s", self.claims_stale_s),
            ("ended_grace_s", self.ended_grace_s),
            ("pose_limit_m", self.pose_limit_m.unwrap_or(1.0)),
            ("cool_down_s", self.cool_down_s),
        ];
        for (field, found) in positive {
            if !(found.is_finite() && found > 0.0) {
                return Err(ConfigError {
                    field,
                    expected: POSITIVE,
                    found,
                });
            }
        }
        let brightening = self.tolerated_brightening;
        if !(brightening.is_finite() && brightening >= 1.0) {
            return Err(ConfigError {
                field: "tolerated_brightening",
                expected: "a finite factor of 1 or more",
                found: brightening,
            });
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
