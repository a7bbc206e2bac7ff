//! The life of alerts: the only place that raises, updates, renames and clears them.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use serde_json::Value;

use super::alert::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Withdrawal,
};
use super::alert_ids::AlertIds;
use super::cleared_causes::ClearedCauses;
use super::finding::{Cause, Content, Finding};
use crate::time::seconds;

/// The alerts of a run: one per cause, from raise to clear.
#[derive(Debug)]
pub(super) struct AlertLifecycle {
    open: BTreeMap<Cause, OpenAlert>,
    cleared: ClearedCauses,
    ids: AlertIds,
    events: Vec<AlertEvent>,
    source_kind: String,
    source_file: Option<String>,
    has_caught_up: bool,
}

#[derive(Clone, Debug)]
struct OpenAlert {
    alert: Alert,
    /// Since when the cause has been absent.
    absent_since: Option<Timestamp>,
    /// How often the cause came back after it had been absent for half of what clears it.
    recurrences: u32,
    /// Taken over from an earlier run and not confirmed in this one.
    is_restored: bool,
}

impl AlertLifecycle {
    /// `cool_down_s` bounds the absence for which an alert whose cause comes and goes stays open.
    pub fn new(source_kind: String, source_file: Option<String>, cool_down_s: f64) -> Self {
        Self {
            open: BTreeMap::new(),
            cleared: ClearedCauses::new(cool_down_s),
            ids: AlertIds::default(),
            events: Vec::new(),
            source_kind,
            source_file,
            has_caught_up: false,
        }
    }

    pub fn set_cool_down(&mut self, cool_down_s: f64) {
        self.cleared.cool_down_s = cool_down_s;
    }

    /// Forgets all causes; gives the alerts that are open.
    pub fn start_again(&mut self) -> Vec<Alert> {
        self.cleared.clear();
        self.has_caught_up = false;
        std::mem::take(&mut self.open)
            .into_values()
            .map(|open| open.alert)
            .collect()
    }

    /// Until this is true once, the absence of a cause from before this run is no evidence.
    pub fn catch_up(&mut self, has_caught_up: bool) {
        self.has_caught_up |= has_caught_up;
    }

    /// The recording that holds the frames from now on.
    pub fn recorded_in(&mut self, file: Option<&std::path::Path>) {
        let file = file.map(|f| f.display().to_string());
        if self.source_file != file {
            self.source_file = file;
        }
    }

    pub fn is_open(&self, cause: &Cause) -> bool {
        self.open.contains_key(cause)
    }

    pub fn raised_at(&self, cause: &Cause) -> Option<Timestamp> {
        self.open.get(cause).map(|open| open.alert.raised_at)
    }

    /// Open alerts by cause.
    pub fn open(&self) -> impl Iterator<Item = (&Cause, &Alert)> {
        self.open.iter().map(|(cause, open)| (cause, &open.alert))
    }

    /// Users with an open alert of this kind.
    pub fn users_with(&self, kind: AlertKind) -> BTreeSet<&str> {
        self.open.keys().filter_map(|cause| cause.user_with(kind)).collect()
    }

    /// Users with an alert of this kind that is open or cleared within the cool-down.
    pub fn users_lately_with(&self, kind: AlertKind, now: Timestamp) -> BTreeSet<&str> {
        let open = self.open.keys().filter_map(|cause| cause.user_with(kind));
        open.chain(self.cleared.users_with(kind, now)).collect()
    }

    /// Whether an open alert is about this user: their position, absence or claims, or a second beam in their spot.
    pub fn concerns(&self, user: &str) -> bool {
        const OF_USERS: [AlertKind; 4] = [
            AlertKind::PositionMismatch,
            AlertKind::UserUnseen,
            AlertKind::UserOutOfZone,
            AlertKind::ClaimsStale,
        ];
        OF_USERS
            .iter()
            .any(|kind| self.is_open(&Cause::User(*kind, user.to_owned())))
            || self.is_open(&Cause::CoLocated(user.to_owned()))
    }

    /// Applies findings in their order.
    pub fn apply(&mut self, findings: Vec<Finding>, now: Timestamp, frame: u64) {
        for finding in findings {
            match finding {
                Finding::Present(cause, content) => self.present(cause, *content, now, frame),
                Finding::Absent(cause) => self.absent(&cause, now),
                Finding::Renamed { from, to } => self.rename(&from, to),
            }
        }
    }

    /// Counts the causes of users without an active claim as absent.
    pub fn absent_without_claim(&mut self, has_claim: impl Fn(&str) -> bool, now: Timestamp) {
        let orphans: Vec<Cause> = self
            .open
            .keys()
            .filter(|cause| cause.user().is_some_and(|user| !has_claim(user)))
            .cloned()
            .collect();
        for cause in orphans {
            self.absent(&cause, now);
        }
    }

    /// `None` when no open alert has this id, or it is acknowledged already and there is nothing to add.
    pub fn acknowledge(&mut self, id: &str, acknowledgement: Acknowledgement) -> Option<AlertEvent> {
        let alert = &mut self.open.values_mut().find(|o| o.alert.id == id)?.alert;
        alert
            .acknowledge(acknowledgement)
            .then(|| alert.event(AlertEventKind::Acknowledged))
    }

    /// `None` when no acknowledged alert has this id.
    pub fn unacknowledge(&mut self, id: &str, withdrawal: Withdrawal) -> Option<AlertEvent> {
        let alert = &mut self.open.values_mut().find(|o| o.alert.id == id)?.alert;
        alert
            .withdraw(withdrawal)
            .then(|| alert.event(AlertEventKind::Unacknowledged))
    }

    /// Takes over an alert that was open when the last run ended; `new_track` gives an id that no track has.
    pub fn restore(&mut self, alert: Alert, new_track: impl FnOnce() -> u64) {
        let cause = Cause::of(&alert, new_track);
        // The first frame shows whether the sensor is back.
        let is_restored = cause != Cause::System(AlertKind::SensorLost);
        self.open.entry(cause).or_insert(OpenAlert {
            alert,
            absent_since: None,
            recurrences: 0,
            is_restored,
        });
    }

    pub fn take_events(&mut self) -> Vec<AlertEvent> {
        std::mem::take(&mut self.events)
    }

    /// Raises the cause's alert, or updates the open one (an event only when its severity rises).
    fn present(&mut self, cause: Cause, mut content: Content, now: Timestamp, frame: u64) {
        if let Some(open) = self.open.get_mut(&cause) {
            open.is_restored = false;
            let hold_s = self.cleared.hold_s(open.recurrences);
            let absent_since = open.absent_since.take();
            if absent_since.is_some_and(|since| seconds(since, now) >= 0.5 * hold_s) {
                open.recurrences += 1;
            }
            let alert = &mut open.alert;
            // An alert never becomes milder while its cause lasts.
            let severity = alert.severity.max(content.severity);
            let has_escalated = severity != alert.severity;
            // What was raised during maintenance and is still there when that ends is sent then.
            let is_released = alert.maintenance.is_some() && content.maintenance.is_none();
            if is_released {
                alert.maintenance = None;
            } else if alert.maintenance.is_none() {
                // Who was sent it is sent what follows.
                let before = alert.webhooks.take();
                content.webhooks = before.zip(content.webhooks).map(|(mut names, more)| {
                    names.extend(more);
                    names.sort_unstable();
                    names.dedup();
                    names
                });
            }
            content.write_to(alert, open.recurrences);
            alert.severity = severity;
            if has_escalated || is_released {
                alert.source.frame = frame;
                self.events.push(AlertEvent {
                    released: is_released,
                    ..alert.event(AlertEventKind::Updated)
                });
            }
            return;
        }
        self.raise(cause, content, now, frame);
    }

    fn raise(&mut self, cause: Cause, content: Content, now: Timestamp, frame: u64) {
        let place = content.x_m.zip(content.y_m).map(|(x, y)| [x, y]);
        let recurrences = self.cleared.take(&cause, place, now).map_or(0, |n| n + 1);
        let mut alert = Alert {
            id: self.ids.next(cause.kind(), now),
            kind: cause.kind(),
            severity: content.severity,
            state: AlertState::Open,
            raised_at: now,
            cleared_at: None,
            user: cause.user().map(str::to_owned),
            x_m: None,
            y_m: None,
            z_m: None,
            geodetic: None,
            cov_m2: None,
            claimed: None,
            evidence: Value::Null,
            source: AlertSource {
                kind: self.source_kind.clone(),
                frame,
                file: self.source_file.clone(),
            },
            zone: None,
            webhooks: None,
            maintenance: content.maintenance.clone(),
            acknowledgement: None,
            station: None,
        };
        content.write_to(&mut alert, recurrences);
        self.events.push(alert.event(AlertEventKind::Raised));
        let open = OpenAlert {
            alert,
            absent_since: None,
            recurrences,
            is_restored: false,
        };
        self.open.insert(cause, open);
    }

    /// Clears after a second of absence; after twice as long each time the cause has come back from half of that or within
    /// the cool-down, so that a flapping cause stays one open alert.
    fn absent(&mut self, cause: &Cause, now: Timestamp) {
        let Some(open) = self.open.get_mut(cause) else {
            return;
        };
        if open.is_restored && !self.has_caught_up {
            return;
        }
        let since = *open.absent_since.get_or_insert(now);
        if seconds(since, now) >= self.cleared.hold_s(open.recurrences) {
            self.clear(cause, now);
        }
    }

    fn clear(&mut self, cause: &Cause, now: Timestamp) {
        let Some(mut open) = self.open.remove(cause) else {
            return;
        };
        open.alert.state = AlertState::Cleared;
        open.alert.cleared_at = Some(now);
        let place = open.alert.x_m.zip(open.alert.y_m).map(|(x, y)| [x, y]);
        self.cleared.push(cause.clone(), open.recurrences, place, now);
        self.events.push(open.alert.event(AlertEventKind::Cleared));
    }

    fn rename(&mut self, from: &Cause, to: Cause) {
        if let Some(open) = self.open.remove(from) {
            self.open.insert(to, open);
        }
    }
}

#[cfg(test)]
#[path = "alert_lifecycle_test.rs"]
mod tests;
