use serde::{Deserialize, Serialize};

/// `[monitor]`: what the operator understands, from which the statistical tests are derived.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A user this far from the claim is still where they say.
    pub tolerated_distance_m: f64,
    pub false_alerts_per_month: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            tolerated_distance_m: 5.0,
            false_alerts_per_month: 1.0,
        }
    }
}
