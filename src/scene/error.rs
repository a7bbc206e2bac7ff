//! Why a scene cannot be used.

use std::path::PathBuf;

use crate::optics;
use crate::toml_file::{self, OutOfRange};

/// Why a scene cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    File(#[from] toml_file::Error),
    #[error("{path}: {reason}")]
    Scene { path: PathBuf, reason: Box<Self> },
    #[error(transparent)]
    Optics(#[from] optics::Error),
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}
