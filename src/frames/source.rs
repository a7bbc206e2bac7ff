//! The interface of a source of frames.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;

use crate::claim::Claim;
use crate::frame::Frame;

/// A source of frames. It runs on a thread of its own, so `next` may block.
pub trait FrameSource: Send {
    /// Waits up to `patience` for the next frame.
    fn next(&mut self, patience: Duration) -> Next;

    /// The recording that holds the last frame given, where there is one.
    fn file(&self) -> Option<&Path> {
        None
    }

    /// Whether the source waits for its reader (a recording) instead of dropping frames (a device).
    fn waits(&self) -> bool {
        false
    }
}

/// Result of waiting for a frame.
#[derive(Clone, Debug)]
pub enum Next {
    /// A frame, with the claims that came with it (simulator, our own recordings; otherwise none).
    Frame(Frame, Vec<Claim>),
    /// No usable frame at `time`: it was short or flagged as corrupt, or none came for a whole second. Every failure of the
    /// sensor reaches the monitor as one of these, so that a recording of them gives the same alerts.
    Unusable {
        index: u64,
        time: Timestamp,
        reason: String,
        /// As with a frame.
        claims: Vec<Claim>,
    },
    /// Nothing yet; ask again.
    Nothing,
    /// The recording has ended.
    End,
}
