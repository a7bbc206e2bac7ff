//! Errors of opening a source of frames.

use std::path::PathBuf;

use super::npy;
use crate::scene;
use crate::toml_file::OutOfRange;

/// Why a source cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
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
    /// Whether the config is wrong, rather than a file that it names.
    pub fn is_config(&self) -> bool {
        !matches!(
            self,
            Self::Npy(_) | Self::Recording { .. } | Self::Index { .. } | Self::NoRecording { .. }
        )
    }

    /// Whether the disk or quota is full.
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
