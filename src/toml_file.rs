//! Reads TOML files and checks their values; an error names the file, the line or key, what was expected and what was found.

use std::fmt::Debug;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use crate::small_file;

/// Why a TOML file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: {message}{nearest}")]
    Malformed {
        path: PathBuf,
        message: String,
        nearest: Nearest,
    },
}

/// The known key most similar to an unknown one.
#[derive(Debug)]
pub struct Nearest(Option<String>);

impl std::fmt::Display for Nearest {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.0 {
            Some(key) => write!(f, "did you mean `{key}`?"),
            None => Ok(()),
        }
    }
}

/// Reads a TOML file into `T`, naming line, column and, for an unknown key, the nearest known one.
pub fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, Error> {
    let text = small_file::read(path).map_err(|source| Error::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    toml::from_str(&text).map_err(|e| Error::Malformed {
        path: path.to_owned(),
        message: e.to_string(),
        nearest: Nearest(nearest_key(e.message())),
    })
}

/// The known name in serde's "unknown field `a`, expected one of `b`, `c`" that is nearest to the unknown one.
fn nearest_key(message: &str) -> Option<String> {
    let is_unknown = ["unknown field", "unknown variant"]
        .iter()
        .any(|p| message.starts_with(p));
    let mut names = message.split('`').skip(1).step_by(2);
    let wrong = names.next().filter(|_| is_unknown)?;
    nearest(wrong, names).map(str::to_owned)
}

/// The name most similar to `wrong` (Jaro–Winkler similarity).
pub fn nearest<'a>(wrong: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    names.max_by(|a, b| strsim::jaro_winkler(wrong, a).total_cmp(&strsim::jaro_winkler(wrong, b)))
}

/// A value outside the range of its key.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{key}: expected {expected}, found {found}")]
pub struct OutOfRange {
    /// The key's full name, like `user[2].motion.walk.speed_m_s`.
    pub key: String,
    pub expected: String,
    /// The value as the file would write it.
    pub found: String,
}

/// The full name of a key, and checks of its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key(String);

impl Key {
    pub fn new(name: impl Into<String>) -> Self {
        Self(name.into())
    }

    /// `self.name`.
    pub fn at(&self, name: &str) -> Self {
        match self.0.is_empty() {
            true => Self(name.to_owned()),
            false => Self(format!("{}.{name}", self.0)),
        }
    }

    /// `self[k]`.
    pub fn index(&self, k: usize) -> Self {
        Self(format!("{}[{k}]", self.0))
    }

    /// `self.name[k]`.
    pub fn item(&self, name: &str, k: usize) -> Self {
        self.at(name).index(k)
    }

    pub fn refuse(&self, expected: impl Into<String>, found: impl Debug) -> OutOfRange {
        OutOfRange {
            key: self.0.clone(),
            expected: expected.into(),
            found: format!("{found:?}"),
        }
    }

    fn check<T: Copy + Debug>(&self, value: T, is_valid: bool, expected: &str) -> Result<T, OutOfRange> {
        is_valid.then_some(value).ok_or_else(|| self.refuse(expected, value))
    }

    pub fn positive(&self, value: f64) -> Result<f64, OutOfRange> {
        self.check(value, value.is_finite() && value > 0.0, "a positive finite number")
    }

    pub fn non_negative(&self, value: f64) -> Result<f64, OutOfRange> {
        let is_valid = value.is_finite() && value >= 0.0;
        self.check(value, is_valid, "zero or a positive finite number")
    }

    pub fn finite(&self, value: f64) -> Result<f64, OutOfRange> {
        self.check(value, value.is_finite(), "a finite number")
    }

    pub fn fraction(&self, value: f64) -> Result<f64, OutOfRange> {
        self.check(value, (0.0..=1.0).contains(&value), "a fraction from 0 to 1")
    }

    pub fn finite_pair(&self, value: [f64; 2]) -> Result<[f64; 2], OutOfRange> {
        self.check(value, value.iter().all(|v| v.is_finite()), "two finite numbers")
    }

    /// Checks `value` against a range; `reason` says why the range ends there, for the message.
    pub fn within(&self, value: f64, range: RangeInclusive<f64>, reason: &str) -> Result<f64, OutOfRange> {
        let expected = format!("{} to {} ({reason})", plain(*range.start()), plain(*range.end()));
        self.check(value, range.contains(&value), &expected)
    }
}

/// A number without an exponent where that is short.
fn plain(value: f64) -> String {
    match value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        true => value.to_string(),
        false => format!("{value:e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_out_of_range_is_named_with_its_key() {
        let key = Key::new("").at("user").index(2).at("speed_m_s");
        let refused = key.positive(-1.0).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "user[2].speed_m_s: expected a positive finite number, found -1.0"
        );
        assert_eq!(key.within(3.0, 0.5..=4.0, "walking"), Ok(3.0));
        for wrong in [0.4, f64::NAN, f64::INFINITY] {
            assert!(key.within(wrong, 0.5..=4.0, "walking").is_err());
        }
        assert_eq!(
            key.within(5.0, 0.5..=4.0, "walking").unwrap_err().expected,
            "0.5 to 4 (walking)"
        );
    }

    #[test]
    fn an_unknown_key_brings_its_nearest() {
        let message = "unknown field `altitde_m`, expected one of `altitude_m`, `pixels`";
        assert_eq!(nearest_key(message).as_deref(), Some("altitude_m"));
        assert_eq!(nearest_key("invalid type: string \"a\", expected f64"), None);
    }
}
