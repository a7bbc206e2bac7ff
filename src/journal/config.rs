use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[journal]`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// SQLite file; in memory only when left out.
    pub path: Option<PathBuf>,
}
