use std::path::PathBuf;

use crate::{config, optics};

/// Why a scene cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    File(#[from] config::Error),
    #[error("{path}: {reason}")]
    Scene { path: PathBuf, reason: Box<Self> },
    #[error(transparent)]
    Optics(#[from] optics::Error),
    #[error("{field}: expected {expected}, found {found}")]
    Value {
        field: Field,
        expected: &'static str,
        found: Found,
    },
}

/// Full name of a field, like `user[2].motion.walk.speed_m_s`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Field(String);

/// The value that was found, as the file would write it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found(String);

impl Field {
    pub(super) fn new(name: impl Into<String>) -> Self {
        Self(name.into())
    }

    /// `self.name`.
    pub(super) fn at(&self, name: &str) -> Self {
        if self.0.is_empty() {
            Self(name.to_owned())
        } else {
            Self(format!("{}.{name}", self.0))
        }
    }

    /// `self[k]`.
    pub(super) fn index(&self, k: usize) -> Self {
        Self(format!("{}[{k}]", self.0))
    }

    /// `self.name[k]`.
    pub(super) fn item(&self, name: &str, k: usize) -> Self {
        self.at(name).index(k)
    }

    pub(super) fn refuse(&self, expected: &'static str, found: impl std::fmt::Debug) -> Error {
        Error::Value {
            field: self.clone(),
            expected,
            found: Found(format!("{found:?}")),
        }
    }

    pub(super) fn positive(&self, value: f64) -> Result<f64, Error> {
        if value.is_finite() && value > 0.0 {
            Ok(value)
        } else {
            Err(self.refuse("a positive finite number", value))
        }
    }

    pub(super) fn non_negative(&self, value: f64) -> Result<f64, Error> {
        if value.is_finite() && value >= 0.0 {
            Ok(value)
        } else {
            Err(self.refuse("zero or a positive finite number", value))
        }
    }

    pub(super) fn finite(&self, value: f64) -> Result<f64, Error> {
        if value.is_finite() {
            Ok(value)
        } else {
            Err(self.refuse("a finite number", value))
        }
    }

    pub(super) fn fraction(&self, value: f64) -> Result<f64, Error> {
        if (0.0..=1.0).contains(&value) {
            Ok(value)
        } else {
            Err(self.refuse("a fraction from 0 to 1", value))
        }
    }

    pub(super) fn finite_pair(&self, value: [f64; 2]) -> Result<[f64; 2], Error> {
        if value.iter().all(|v| v.is_finite()) {
            Ok(value)
        } else {
            Err(self.refuse("two finite numbers", value))
        }
    }
}

impl std::fmt::Display for Field {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::fmt::Display for Found {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}
