//! One zone: its area, what it does, and who may be there.

use serde::{Deserialize, Serialize};

use super::shape::Shape;
use crate::monitor::alert::Severity;

/// Zones of the config and of the API together. With so many, of 20 corners each, a frame of 26 beams costs
/// some 200 µs more (`oapwatch study zones`).
pub const MAX_ZONES: usize = 1000;

/// What a zone does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ZoneKind {
    /// Beams that nobody claims raise nothing there; they are counted and shown.
    Ignore,
    /// Any beam whose user is not listed is critical at once.
    Restricted,
    /// Its own tolerated distance, severity and webhooks.
    Watch,
}

/// A zone that has been checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Zone {
    pub name: String,
    pub kind: ZoneKind,
    pub shape: Shape,
    /// Users who may be there; a name that ends with `*` stands for all that begin with the rest.
    pub users: Vec<String>,
    /// Replaces `[monitor] tolerated_distance_m` for users who claim to be there.
    pub tolerated_distance_m: Option<f64>,
    /// Replaces the severity of alerts about beams there.
    pub severity: Option<Severity>,
    /// Names of the only webhooks that get alerts about beams there; all when `None`.
    pub webhooks: Option<Vec<String>>,
    /// Set in the config, so that the API does not change it.
    pub is_fixed: bool,
}

impl Zone {
    /// Whether the zone lists this user.
    pub fn lists(&self, user: &str) -> bool {
        self.users.iter().any(|listed| match listed.strip_suffix('*') {
            Some(beginning) => user.starts_with(beginning),
            None => user == listed,
        })
    }
}
