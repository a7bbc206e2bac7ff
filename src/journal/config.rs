//! `[journal]`: the file and what is kept in it.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::toml_file::{Key, OutOfRange};

/// `[journal]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// SQLite file; in memory only when left out.
    pub path: Option<PathBuf>,
    /// Cleared alerts older than this are removed, d.
    pub keep_days: u32,
    /// Beyond this size the oldest cleared alerts are removed early, MB (10⁶ bytes).
    pub max_mb: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            path: None,
            keep_days: 90,
            max_mb: 512,
        }
    }
}

/// Why a `[journal]` table cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    #[error("journal.path: {path}: expected a file in a folder that exists, found no folder {folder}")]
    NoFolder { path: PathBuf, folder: PathBuf },
    #[error("journal.path: {path}: expected a file, found a folder")]
    IsFolder { path: PathBuf },
}

impl Config {
    /// Checks every number, and that the journal's folder exists.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let key = Key::new("journal");
        key.at("keep_days").within(
            self.keep_days.into(),
            1.0..=36_500.0,
            "a cleared alert is kept for a day at least",
        )?;
        key.at("max_mb").within(
            self.max_mb.into(),
            1.0..=1e6,
            "an empty journal takes a good part of one MB",
        )?;
        let Some(path) = &self.path else { return Ok(()) };
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
            _ => PathBuf::from("."),
        };
        let is_folder = |path: &Path| path.metadata().map(|m| m.is_dir());
        match is_folder(&folder) {
            // A folder that only the service may look into is no mistake.
            Err(e) if e.kind() != ErrorKind::NotFound => return Ok(()),
            Ok(true) => {}
            Ok(false) | Err(_) => {
                return Err(ConfigError::NoFolder {
                    path: path.clone(),
                    folder,
                });
            }
        }
        match is_folder(path) {
            Ok(true) => Err(ConfigError::IsFolder { path: path.clone() }),
            Ok(false) | Err(_) => Ok(()),
        }
    }
}
