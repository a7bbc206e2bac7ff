//! Floor 2: where frames come from: the built-in simulator, a V4L2 device, a recording.

mod capture;
mod config;
pub mod npy;
pub mod record;
mod replay;
mod simulator;
mod slot;
pub mod v4l2;

pub use capture::{Capture, Captured};
pub use config::{Config, SourceKind};
pub use simulator::Simulator;

use std::path::{Path, PathBuf};
use std::time::Duration;

use jiff::Timestamp;

use crate::claim::Claim;
use crate::frame::Frame;
use crate::optics::Camera;
use crate::scene;

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

/// Why a source cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("source.{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error("source.{field}: needed for kind = {kind:?}, found nothing")]
    Missing { field: &'static str, kind: &'static str },
    #[error(
        "source.scene: the scene's array is {found_x} × {found_y} pixels, optics.pixels says {expected_x} × {expected_y}"
    )]
    SceneShape {
        expected_x: usize,
        expected_y: usize,
        found_x: usize,
        found_y: usize,
    },
    #[error(transparent)]
    Scene(#[from] scene::Error),
    #[error("optics.joules_per_count: needed for source.kind = \"v4l2\", whose frames are counts; found nothing")]
    NoScale,
    #[error("{path}: {source}")]
    Recording { path: PathBuf, source: std::io::Error },
    #[error("{path}: line {line}: {source}")]
    Index {
        path: PathBuf,
        line: u64,
        source: serde_json::Error,
    },
    #[error("{path}: expected recordings (NAME.npy with NAME.frames.ndjson), found none")]
    NoRecording { path: PathBuf },
    #[error("source.loop: a recording with times of its own cannot be looped; set source.start to give it new ones")]
    LoopWithTimes,
    #[error(transparent)]
    Npy(#[from] npy::Error),
}

impl Error {
    /// Whether the config is at fault, not what it points at.
    pub fn is_config(&self) -> bool {
        !matches!(
            self,
            Self::Npy(_) | Self::Recording { .. } | Self::Index { .. } | Self::NoRecording { .. }
        )
    }

    /// Whether there was no room to write.
    pub fn is_full_disk(&self) -> bool {
        use std::io::ErrorKind::{QuotaExceeded, StorageFull};
        match self {
            Self::Npy(npy::Error::Io { source, .. }) | Self::Recording { source, .. } => {
                matches!(source.kind(), StorageFull | QuotaExceeded)
            }
            _ => false,
        }
    }
}

/// Opens the configured source. A device that is not there yet is no error: it is waited for.
pub fn open(config: &Config, camera: &Camera) -> Result<Box<dyn FrameSource>, Error> {
    match config.kind {
        SourceKind::Replay => replay::open(config, camera.joules_per_count),
        SourceKind::V4l2 => Ok(Box::new(v4l2::V4l2::new(config, camera)?)),
        SourceKind::Simulator => Ok(Box::new(Simulator::open(config, camera)?)),
    }
}
