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
        let size = "MB; the largest file systems hold 1e9";
        key.at("limit_mb").within(self.limit_mb, 1e-3..=1e9, size)?;
        key.at("evidence_limit_mb")
            .within(self.evidence_limit_mb, 1e-3..=1e9, size)?;
        let segment = "a file that covers more than a day is never removed in time";
        key.at("segment_s").within(self.segment_s, 0.01..=86_400.0, segment)?;
        let clip = "evidence is a clip around an alert";
        key.at("before_s").within(self.before_s, 1e-3..=3600.0, clip)?;
        key.at("after_s").within(self.after_s, 1e-3..=3600.0, clip)?;
        Ok(())
    }
}
