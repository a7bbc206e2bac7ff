//! `[record]`: how the input of the monitor is recorded.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::frames::Error;
use crate::toml_file::Key;

/// `[record]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Folder of the recordings; nothing is recorded when left out.
    pub folder: Option<PathBuf>,
    /// Size of the ring, MB; the oldest files are removed beyond it.
    pub limit_mb: f64,
    /// Length of one file, s.
    pub segment_s: f64,
    /// Time before and after an alert that its evidence covers, s.
    pub before_s: f64,
    pub after_s: f64,
    /// Size of all evidence, in the folder `evidence` beside the ring, MB; the oldest is removed beyond it.
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
    /// Checks every number.
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
