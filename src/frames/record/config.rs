use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::frames::Error;
use crate::toml_file::Key;

/// `[record]`: what the monitor sees, kept on disk.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where to record; nothing is recorded when left out.
    pub folder: Option<PathBuf>,
    /// Size of the ring: the oldest files make way.
    pub limit_mb: f64,
    /// Length of one file.
    pub segment_s: f64,
    /// What an alert's evidence holds before and after it.
    pub before_s: f64,
    pub after_s: f64,
    /// Size of all evidence, in the folder `evidence` beside the ring: the oldest makes way.
    pub evidence_limit_mb: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            folder: None,
            limit_mb: 1024.0,
            segment_s: 60.0,
            before_s: 10.0,
            after_s: 10.0,
            evidence_limit_mb: 1024.0,
        }
    }
}

impl Config {
    /// Refuses what no recorder can do.
    pub fn check(&self) -> Result<(), Error> {
        let key = Key::new("record");
        key.at("limit_mb").positive(self.limit_mb)?;
        key.at("segment_s").positive(self.segment_s)?;
        key.at("before_s").positive(self.before_s)?;
        key.at("after_s").positive(self.after_s)?;
        key.at("evidence_limit_mb").positive(self.evidence_limit_mb)?;
        Ok(())
    }
}
