use serde::{Deserialize, Serialize};

/// `[estimator]`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A rung of the ladder; the embedded default when left out.
    pub name: Option<String>,
    /// Time allowed a frame; the best rung finished within it is returned.
    pub budget_ms: Option<f64>,
}
