use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::KnownPower;

/// `[estimator]`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A rung of the ladder; the embedded default when left out.
    pub name: Option<String>,
    /// ONNX file of the `network` and `hybrid` rungs, its card beside it; the embedded one when left out.
    pub network: Option<PathBuf>,
    /// Time allowed a frame; the best rung finished within it is returned.
    pub budget_ms: Option<f64>,
    /// What the `map` rung may take for known of users' power; `map` without it is `ml` with another price of emitters.
    pub known_power: Option<KnownPower>,
}
