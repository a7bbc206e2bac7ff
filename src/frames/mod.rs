//! Floor 2: where frames come from: the built-in simulator, a V4L2 device, a recording.

mod config;
pub mod npy;

pub use config::{Config, SourceKind};

use std::time::Duration;

use crate::claim::Claim;
use crate::frame::Frame;

/// A supply of frames with a thread of its own to block in.
pub trait FrameSource: Send {
    /// Waits up to `patience` for the next frame.
    fn next(&mut self, patience: Duration) -> Next;
}

/// What a wait for a frame ended with.
#[derive(Debug)]
pub enum Next {
    /// A frame, with the claims that came with it (simulator, our own recordings; otherwise none).
    Frame(Frame, Vec<Claim>),
    /// A frame arrived that cannot be used (short, error-flagged, wrong format).
    Unusable { reason: String },
    /// Nothing in time; ask again.
    Nothing,
    /// A recording came to its end.
    End,
}
