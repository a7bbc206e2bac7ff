//! The interface of a source of frames.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::claim::Claim;
use crate::frame::Frame;
use crate::pose::Pose;

/// A source of frames. It runs on a thread of its own, so `next` may block.
pub trait FrameSource: Send {
    /// Waits up to `patience` for the next frame.
    fn next(&mut self, patience: Duration) -> Next;

    /// The recording that holds the last frame given, where there is one.
    fn file(&self) -> Option<&Path> {
        None
    }

    /// Why the recording has ended before its time, where it has.
    fn failure(&self) -> Option<&str> {
        None
    }

    /// Whether the source waits for its reader (a recording) instead of dropping frames (a device).
    fn waits(&self) -> bool {
        false
    }
}

/// What came with a frame, or since the one before: from the simulator and our own recordings, otherwise nothing.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Arrivals {
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub claims: Vec<Claim>,
    /// Of the platform, in the order in which they came.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub poses: Vec<Pose>,
}

impl Arrivals {
    /// Adds what came later.
    pub fn append(&mut self, mut later: Self) {
        self.claims.append(&mut later.claims);
        self.poses.append(&mut later.poses);
    }
}

impl From<Vec<Claim>> for Arrivals {
    fn from(claims: Vec<Claim>) -> Self {
        Self {
            claims,
            poses: Vec::new(),
        }
    }
}

/// Result of waiting for a frame.
#[derive(Clone, Debug)]
pub enum Next {
    Frame(Frame, Arrivals),
    /// No usable frame at `time`: it was short or flagged as corrupt, or none came for a whole second. Every failure of the
    /// sensor reaches the monitor as one of these, so that a recording of them gives the same alerts.
    Unusable {
        index: u64,
        time: Timestamp,
        reason: String,
        arrivals: Arrivals,
    },
    /// Nothing yet; ask again.
    Nothing,
    /// The recording has ended.
    End,
}
