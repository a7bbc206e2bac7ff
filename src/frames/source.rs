//! What every source of frames gives.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;

use crate::claim::Claim;
use crate::frame::Frame;

/// A supply of frames with a thread of its own to block in.
pub trait FrameSource: Send {
    /// Waits up to `patience` for the next frame.
    fn next(&mut self, patience: Duration) -> Next;

    /// The recording that holds the frame last given, where there is one.
    fn file(&self) -> Option<&Path> {
        None
    }

    /// Whether the source waits for its reader (a recording), or frames come and go (a device).
    fn waits(&self) -> bool {
        false
    }
}

/// What a wait for a frame ended with.
#[derive(Clone, Debug)]
pub enum Next {
    /// A frame, with the claims that came with it (simulator, our own recordings; otherwise none).
    Frame(Frame, Vec<Claim>),
    /// No usable frame at `time`: it was short or error-flagged, or none came for a whole second. All that
    /// the monitor needs to know about a failing sensor comes as one of these, so that a recording of them
    /// gives the same alerts.
    Unusable {
        index: u64,
        time: Timestamp,
        reason: String,
        /// As with a frame.
        claims: Vec<Claim>,
    },
    /// Nothing yet; ask again.
    Nothing,
    /// A recording came to its end.
    End,
}
