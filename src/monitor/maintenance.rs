//! Maintenance: windows of time, set by a named person, in which alerts are recorded and not sent.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// Windows that are kept at a time.
const MAX_WINDOWS: usize = 100;
/// Longest window, s: a week. One that does not end turns the alerts off.
const MAX_LENGTH_S: f64 = 7.0 * 86_400.0;
/// Characters of a name and of a note.
const MAX_NAME: usize = 64;
const MAX_NOTE: usize = 1000;

/// One `[[maintenance]]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub from: Timestamp,
    pub until: Timestamp,
    /// Who answers for it.
    pub by: String,
    #[serde(default)]
    pub note: Option<String>,
}

/// A window, as the API shows it and the journal keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Window {
    pub id: String,
    #[schema(value_type = String, format = DateTime)]
    pub from: Timestamp,
    #[schema(value_type = String, format = DateTime)]
    pub until: Timestamp,
    /// Who answers for it.
    pub by: String,
    pub note: Option<String>,
    /// Set in the config, so that the API does not change it.
    pub is_fixed: bool,
}

/// Why a window cannot be taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MaintenanceError {
    #[error("until: expected a time after {from}, by a week at most, found {until}")]
    Length { from: Timestamp, until: Timestamp },
    #[error("{key}: expected {expected}, found {found:?}")]
    Text {
        key: &'static str,
        expected: &'static str,
        found: String,
    },
    #[error("expected at most {MAX_WINDOWS} maintenance windows, found {MAX_WINDOWS} and another")]
    TooMany,
    #[error("a hub has none of its own: set them at the access points")]
    AtHub,
    #[error("no maintenance window has the id {0:?}")]
    Unknown(String),
    #[error("maintenance window {0:?} is set in the config, not through the API")]
    Fixed(String),
}

impl Window {
    pub fn check(&self) -> Result<(), MaintenanceError> {
        let length_s = crate::time::seconds(self.from, self.until);
        if !(length_s > 0.0 && length_s <= MAX_LENGTH_S) {
            return Err(MaintenanceError::Length {
                from: self.from,
                until: self.until,
            });
        }
        let fault = |key, expected, found: &str| {
            Err(MaintenanceError::Text {
                key,
                expected,
                found: found.chars().take(80).collect(),
            })
        };
        let name = self.by.trim();
        if name.is_empty() || name.chars().count() > MAX_NAME || name.chars().any(char::is_control) {
            return fault("by", "the name of who answers for it, at most 64 characters", &self.by);
        }
        let is_odd = |c: char| c.is_control() && !['\n', '\r', '\t'].contains(&c);
        match &self.note {
            Some(note) if note.chars().count() > MAX_NOTE || note.contains(is_odd) => fault(
                "note",
                "at most 1000 characters, no control characters but line breaks and tabs",
                note,
            ),
            _ => Ok(()),
        }
    }
}

/// The windows of a config, checked.
pub fn windows_of(configs: &[Config]) -> Result<Vec<Window>, String> {
    let mut windows = Vec::new();
    for (k, config) in configs.iter().enumerate() {
        let window = Window {
            id: format!("config-{}", k + 1),
            from: config.from,
            until: config.until,
            by: config.by.clone(),
            note: config.note.clone(),
            is_fixed: true,
        };
        window.check().map_err(|e| format!("maintenance {}: {e}", k + 1))?;
        windows.push(window);
    }
    match windows.len() > MAX_WINDOWS {
        true => Err(format!("maintenance: {}", MaintenanceError::TooMany)),
        false => Ok(windows),
    }
}

/// The windows in force and to come.
#[derive(Debug, Default)]
pub(super) struct Maintenance {
    windows: Vec<Window>,
}

impl Maintenance {
    /// The window that ends last of those in force.
    pub fn in_force(&self, now: Timestamp) -> Option<&Window> {
        let in_force = self.windows.iter().filter(|w| w.from <= now && now < w.until);
        in_force.max_by_key(|w| w.until)
    }

    /// Those that have not ended.
    pub fn windows(&self, now: Timestamp) -> Vec<Window> {
        self.windows.iter().filter(|w| now < w.until).cloned().collect()
    }

    /// Forgets and returns those that have ended.
    pub fn take_ended(&mut self, now: Timestamp) -> Vec<Window> {
        self.windows.extract_if(.., |w| w.until <= now).collect()
    }

    /// Puts the config's windows in force in place of those of an earlier config.
    pub fn set_fixed(&mut self, windows: Vec<Window>) {
        self.windows.retain(|w| !w.is_fixed);
        self.windows.extend(windows);
    }

    pub fn add(&mut self, window: Window) -> Result<(), MaintenanceError> {
        window.check()?;
        if self.windows.len() >= MAX_WINDOWS {
            return Err(MaintenanceError::TooMany);
        }
        self.windows.push(window);
        Ok(())
    }

    pub fn remove(&mut self, id: &str) -> Result<Window, MaintenanceError> {
        let k = self.windows.iter().position(|w| w.id == id);
        let k = k.ok_or_else(|| MaintenanceError::Unknown(id.chars().take(64).collect()))?;
        match self.windows[k].is_fixed {
            true => Err(MaintenanceError::Fixed(id.to_owned())),
            false => Ok(self.windows.remove(k)),
        }
    }
}
