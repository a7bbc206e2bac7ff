//! The checks of zones that the config and the API share.

use std::collections::BTreeSet;

use super::shape::ShapeError;
use super::zone::{MAX_ZONES, Zone, ZoneKind};

/// Corners of all zones together: the time and memory that zones may take.
const MAX_CORNERS: usize = 20_000;
/// Characters of a name.
pub(super) const MAX_NAME: usize = 64;
/// Users, and webhooks, that a zone lists.
const MAX_LISTED: usize = 1000;
/// Users that all zones list together, and of these, beginnings of names, each of which is compared with every user.
const MAX_USERS: usize = 10_000;
const MAX_BEGINNINGS: usize = 100;

/// Why zones cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {reason}")]
pub struct ZoneError {
    /// The zone and its key.
    pub place: String,
    pub reason: String,
}

impl ZoneError {
    pub(super) fn new(place: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            place: place.into(),
            reason: reason.into(),
        }
    }
}

pub(super) fn too_many(found: usize) -> ZoneError {
    ZoneError::new("zone", format!("expected at most {MAX_ZONES} zones, found {found}"))
}

/// Checks zones against each other.
pub(in crate::monitor) fn check_all(zones: &[Zone]) -> Result<(), ZoneError> {
    if zones.len() > MAX_ZONES {
        return Err(too_many(zones.len()));
    }
    let corners: usize = zones.iter().map(|z| z.shape.corners()).sum();
    if corners > MAX_CORNERS {
        let reason = format!("expected at most {MAX_CORNERS} corners of all zones together, found {corners}");
        return Err(ZoneError::new("zone", reason));
    }
    let listed = || zones.iter().flat_map(|zone| &zone.users);
    for (what, most, found) in [
        ("users", MAX_USERS, listed().count()),
        (
            "beginnings of names (…*)",
            MAX_BEGINNINGS,
            listed().filter(|u| u.ends_with('*')).count(),
        ),
    ] {
        if found > most {
            let reason = format!("expected at most {most} {what} of all zones together, found {found}");
            return Err(ZoneError::new("zone.users", reason));
        }
    }
    let mut names = BTreeSet::new();
    for zone in zones {
        if !names.insert(zone.name.as_str()) {
            let reason = format!("expected a name that no other zone has, found {:?} twice", zone.name);
            return Err(ZoneError::new("zone.name", reason));
        }
    }
    Ok(())
}

/// Checks all but the shape.
pub(super) fn checked(zone: Zone, place: &dyn Fn(&str) -> String) -> Result<Zone, ZoneError> {
    let fault = |key: &str, reason: String| Err(ZoneError::new(place(key), reason));
    let length = zone.name.chars().count();
    if !(1..=MAX_NAME).contains(&length) || zone.name.chars().any(char::is_control) {
        return fault(
            "name",
            format!(
                "expected 1 to {MAX_NAME} characters, none of them a control character, found {length}: {:?}",
                zone.name
            ),
        );
    }
    for (key, listed) in [("users", Some(&zone.users)), ("webhooks", zone.webhooks.as_ref())] {
        let Some(listed) = listed else { continue };
        if listed.len() > MAX_LISTED {
            return fault(
                key,
                format!("expected at most {MAX_LISTED} names, found {}", listed.len()),
            );
        }
        if listed.iter().any(|name| name.is_empty() || name.len() > 256) {
            return fault(
                key,
                "expected names of 1 to 256 bytes, found an empty or a longer one".to_owned(),
            );
        }
    }
    if zone.kind == ZoneKind::Ignore && !zone.users.is_empty() {
        return fault(
            "users",
            "expected none in a zone of kind \"ignore\", which concerns beams that nobody claims; found some"
                .to_owned(),
        );
    }
    let of_watch = [
        ("tolerated_distance_m", zone.tolerated_distance_m.is_some()),
        ("severity", zone.severity.is_some()),
    ];
    if zone.kind != ZoneKind::Watch
        && let Some((key, _)) = of_watch.into_iter().find(|(_, is_set)| *is_set)
    {
        return fault(key, "expected in a zone of kind \"watch\" only".to_owned());
    }
    if zone.kind == ZoneKind::Ignore && zone.webhooks.is_some() {
        return fault(
            "webhooks",
            "expected in a zone of kind \"watch\" or \"restricted\" only".to_owned(),
        );
    }
    if let Some(found) = zone.tolerated_distance_m.filter(|d| !(1e-3..=1e5).contains(d)) {
        let reason = format!("expected 0.001 to 100000 (metres; no camera sees farther), found {found}");
        return fault("tolerated_distance_m", reason);
    }
    Ok(zone)
}

pub(super) fn shape_error(error: &ShapeError, place: &str) -> ZoneError {
    ZoneError::new(place, error.to_string())
}
