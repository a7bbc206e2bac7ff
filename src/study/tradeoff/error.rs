//! Why a study could not be finished.

use std::path::PathBuf;

/// Why a study could not be finished.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: not a trade-off study: {source}")]
    Malformed { path: PathBuf, source: serde_json::Error },
    #[error("{path}: not a network's card: {source}")]
    Card { path: PathBuf, source: toml::de::Error },
    #[error("cell {cell}: {source}")]
    Optics { cell: String, source: crate::optics::Error },
    #[error(transparent)]
    Estimator(#[from] crate::estimate::ConfigError),
    #[error("{path}: {message}")]
    Picture { path: PathBuf, message: PictureError },
}

/// The error of the plotting library.
#[derive(Debug)]
pub struct PictureError(pub(super) Box<dyn std::error::Error + Send + Sync>);

impl std::fmt::Display for PictureError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}
