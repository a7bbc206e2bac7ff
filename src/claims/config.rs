use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[claims]`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// NDJSON log, followed like `tail -F`.
    pub log: Option<PathBuf>,
}
