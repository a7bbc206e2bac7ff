//! `[journal]`: the file and what is kept in it.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[journal]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// SQLite file; in memory only when left out.
    pub path: Option<PathBuf>,
    /// Cleared alerts older than this are removed, d.
    pub keep_days: u32,
    /// Beyond this size the oldest cleared alerts are removed early, MB (10⁶ bytes).
    pub max_mb: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            path: None,
            keep_days: 90,
            max_mb: 512,
        }
    }
}
