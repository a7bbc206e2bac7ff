use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::frames::Error;

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
        let numbers = [
            ("record.limit_mb", self.limit_mb),
            ("record.segment_s", self.segment_s),
            ("record.before_s", self.before_s),
            ("record.after_s", self.after_s),
            ("record.evidence_limit_mb", self.evidence_limit_mb),
        ];
        match numbers.into_iter().find(|(_, n)| !(n.is_finite() && *n > 0.0)) {
            None => Ok(()),
            Some((field, found)) => Err(Error::OutOfRange {
                field,
                expected: "a positive finite number",
                found,
            }),
        }
    }
}
