use std::collections::BTreeMap;

use jiff::Timestamp;
use serde_json::Value;

use crate::claims::seconds;
use crate::monitor::alert::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, SAME_PLACE_M, Severity,
    Withdrawal,
};

/// What an alert is about: while one is open for a cause, the cause raises no other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    User(AlertKind, String),
    Track(AlertKind, u64),
    /// A second beam within this user's spot.
    Spot(String),
    Whole(AlertKind),
}

/// What is known of a cause in this frame.
#[derive(Clone, Debug)]
pub(super) struct Finding {
    pub severity: Severity,
    pub x_m: Option<f64>,
    pub y_m: Option<f64>,
    pub cov_m2: Option<[[f64; 2]; 2]>,
    pub claimed: Option<Value>,
    pub evidence: Value,
}

#[derive(Clone, Debug)]
struct Open {
    alert: Alert,
    /// Since when the cause has been absent.
    quiet_since: Option<Timestamp>,
    /// How often the cause came back after it had been absent for half of what clears it.
    recurrences: u32,
    /// Taken over from an earlier run and not seen in this one.
    is_unseen: bool,
}

impl Open {
    /// Absence that clears, s.
    fn hold_s(&self, cool_down_s: f64) -> f64 {
        (CLEAR_S * 2f64.powi(self.recurrences.min(20) as i32)).min(cool_down_s)
    }
}

/// A cause that cleared lately.
#[derive(Clone, Copy, Debug)]
struct Cleared {
    at: Timestamp,
    /// How often it had come back.
    recurrences: u32,
    place: Option<[f64; 2]>,
}

/// The alerts of a run: raised once per cause, updated, acknowledged, cleared.
#[derive(Debug)]
pub(super) struct AlertLifecycle {
    open: BTreeMap<Cause, Open>,
    cleared: BTreeMap<Cause, Cleared>,
    /// Alerts of each kind raised at the newest instant: a flood of them must not cost more than their number.
    numbered: (Timestamp, BTreeMap<AlertKind, u32>),
    events: Vec<AlertEvent>,
    source_kind: String,
    source_file: Option<String>,
    cool_down_s: f64,
    has_caught_up: bool,
}

/// A cause absent for this long is over, at its first occurrence.
const CLEAR_S: f64 = 1.0;
/// Causes remembered after they cleared.
const MOST_CLEARED: usize = 10_000;

impl Cause {
    pub fn kind(&self) -> AlertKind {
        match self {
            Self::User(kind, _) | Self::Track(kind, _) | Self::Whole(kind) => *kind,
            Self::Spot(_) => AlertKind::UnclaimedEmitter,
        }
    }

    /// The user that the cause is about, if it is about one.
    pub fn names(&self) -> Option<&str> {
        match self {
            Self::User(_, user) | Self::Spot(user) => Some(user),
            Self::Track(..) | Self::Whole(_) => None,
        }
    }

    fn user(&self) -> Option<&str> {
        match self {
            Self::User(_, user) => Some(user),
            _ => None,
        }
    }
}

impl Finding {
    pub fn new(severity: Severity, evidence: Value) -> Self {
        Self {
            severity,
            x_m: None,
            y_m: None,
            cov_m2: None,
            claimed: None,
            evidence,
        }
    }
}

impl AlertLifecycle {
    pub fn new(source_kind: String, source_file: Option<String>, cool_down_s: f64) -> Self {
        Self {
            open: BTreeMap::new(),
            cleared: BTreeMap::new(),
            numbered: (Timestamp::UNIX_EPOCH, BTreeMap::new()),
            events: Vec::new(),
            source_kind,
            source_file,
            cool_down_s,
            has_caught_up: false,
        }
    }

    /// Lets go of all causes; gives the alerts that stand.
    pub fn start_again(&mut self) -> Vec<Alert> {
        self.cleared.clear();
        self.has_caught_up = false;
        std::mem::take(&mut self.open)
            .into_values()
            .map(|open| open.alert)
            .collect()
    }

    /// Until then the absence of a cause from before this run says nothing.
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

    pub fn open(&self) -> impl Iterator<Item = (&Cause, &Alert)> {
        self.open.iter().map(|(cause, open)| (cause, &open.alert))
    }

    /// Users with an alert of this kind that is open or cleared within the cool-down.
    pub fn users_lately(&self, kind: AlertKind, now: Timestamp) -> usize {
        let is_of = |cause: &Cause| matches!(cause, Cause::User(of, _) if *of == kind);
        let open = self.open.keys().filter(|cause| is_of(cause)).count();
        let cleared = self.cleared.iter().filter(|(cause, _)| is_of(cause));
        open + cleared.filter(|(_, c)| seconds(c.at, now) <= self.cool_down_s).count()
    }

    /// The cause is there: raises its alert, or brings the open one up to date (an event only when its severity changed).
    pub fn report(&mut self, cause: &Cause, finding: Finding, now: Timestamp, frame: u64) {
        if let Some(open) = self.open.get_mut(cause) {
            open.is_unseen = false;
            let hold_s = open.hold_s(self.cool_down_s);
            let quiet_since = open.quiet_since.take();
            if quiet_since.is_some_and(|since| seconds(since, now) >= 0.5 * hold_s) {
                open.recurrences += 1;
            }
            let alert = &mut open.alert;
            // An alert does not grow milder while its cause lasts.
            let severity = alert.severity.max(finding.severity);
            let escalated = severity != alert.severity;
            finding.write_to(alert);
            alert.severity = severity;
            note_recurrences(alert, open.recurrences);
            if escalated {
                alert.source.frame = frame;
                self.events.push(AlertEvent {
                    event: AlertEventKind::Updated,
                    alert: alert.clone(),
                });
            }
            return;
        }
        let recurrences = self.cleared_lately(cause, &finding, now).map_or(0, |n| n + 1);
        let id = self.new_id(cause.kind(), now);
        let mut alert = Alert {
            id,
            kind: cause.kind(),
            severity: finding.severity,
            state: AlertState::Open,
            raised_at: now,
            cleared_at: None,
            user: cause.user().map(str::to_owned),
            x_m: None,
            y_m: None,
            cov_m2: None,
            claimed: None,
            evidence: Value::Null,
            source: AlertSource {
                kind: self.source_kind.clone(),
                frame,
                file: self.source_file.clone(),
            },
            acknowledgement: None,
        };
        finding.write_to(&mut alert);
        note_recurrences(&mut alert, recurrences);
        self.events.push(AlertEvent {
            event: AlertEventKind::Raised,
            alert: alert.clone(),
        });
        self.open.insert(
            cause.clone(),
            Open {
                alert,
                quiet_since: None,
                recurrences,
                is_unseen: false,
            },
        );
    }

    /// How often a cause that cleared within the cool-down had come back by then. A beam has another name each time it
    /// comes on: it is known by its place.
    fn cleared_lately(&mut self, cause: &Cause, finding: &Finding, now: Timestamp) -> Option<u32> {
        let cool_down = self.cool_down_s;
        let is_recent = |c: &Cleared| seconds(c.at, now) <= cool_down;
        let same = match (cause, finding.x_m, finding.y_m) {
            (Cause::Track(..), Some(x), Some(y)) => self
                .cleared
                .iter()
                .filter(|(other, c)| matches!(other, Cause::Track(..)) && is_recent(c))
                .find(|(_, c)| c.place.is_some_and(|[px, py]| (px - x).hypot(py - y) < SAME_PLACE_M))
                .map(|(other, _)| other.clone()),
            _ => Some(cause.clone()),
        };
        self.cleared.remove(&same?).filter(is_recent).map(|c| c.recurrences)
    }

    /// The cause is absent. Its alert clears after a second of that; twice as long each time it comes back from half of that or
    /// within the cool-down, so that a flapping cause stays one open alert.
    pub fn absent(&mut self, cause: &Cause, now: Timestamp) {
        let Some(open) = self.open.get_mut(cause) else {
            return;
        };
        if open.is_unseen && !self.has_caught_up {
            return;
        }
        let since = *open.quiet_since.get_or_insert(now);
        if seconds(since, now) >= open.hold_s(self.cool_down_s) {
            self.clear(cause, now);
        }
    }

    /// The cause is known to be over.
    pub fn clear(&mut self, cause: &Cause, now: Timestamp) {
        if let Some(mut open) = self.open.remove(cause) {
            open.alert.state = AlertState::Cleared;
            open.alert.cleared_at = Some(now);
            let cool_down = self.cool_down_s;
            if self.cleared.len() >= MOST_CLEARED {
                self.cleared.retain(|_, c| seconds(c.at, now) <= cool_down);
            }
            if self.cleared.len() < MOST_CLEARED {
                let place = open.alert.x_m.zip(open.alert.y_m).map(|(x, y)| [x, y]);
                let cleared = Cleared {
                    at: now,
                    recurrences: open.recurrences,
                    place,
                };
                self.cleared.insert(cause.clone(), cleared);
            }
            self.events.push(AlertEvent {
                event: AlertEventKind::Cleared,
                alert: open.alert,
            });
        }
    }

    /// The same cause under another name (a track that was lost and found again).
    pub fn rename(&mut self, from: &Cause, to: Cause) {
        if let Some(open) = self.open.remove(from) {
            self.open.insert(to, open);
        }
    }

    /// `None` when no open alert has this id, or it is acknowledged already and there is nothing to add.
    pub fn acknowledge(&mut self, id: &str, acknowledgement: Acknowledgement) -> Option<AlertEvent> {
        let alert = &mut self.open.values_mut().find(|o| o.alert.id == id)?.alert;
        if alert.state == AlertState::Acknowledged && acknowledgement.note.is_none() {
            return None;
        }
        alert.state = AlertState::Acknowledged;
        alert.acknowledgement = Some(acknowledgement);
        Some(AlertEvent {
            event: AlertEventKind::Acknowledged,
            alert: alert.clone(),
        })
    }

    /// `None` when no acknowledged alert has this id.
    pub fn unacknowledge(&mut self, id: &str, withdrawal: Withdrawal) -> Option<AlertEvent> {
        let alert = &mut self.open.values_mut().find(|o| o.alert.id == id)?.alert;
        if alert.state != AlertState::Acknowledged {
            return None;
        }
        alert.state = AlertState::Open;
        // An alert that was acknowledged before acknowledgements were kept has none.
        if let Some(acknowledgement) = &mut alert.acknowledgement {
            acknowledgement.withdrawn = Some(withdrawal);
        }
        Some(AlertEvent {
            event: AlertEventKind::Unacknowledged,
            alert: alert.clone(),
        })
    }

    /// Takes over an alert that was open when the last run ended.
    pub fn restore(&mut self, cause: Cause, alert: Alert) {
        // Sight shows at once whether it is back.
        let is_unseen = cause != Cause::Whole(AlertKind::SensorLost);
        self.open.entry(cause).or_insert(Open {
            alert,
            quiet_since: None,
            recurrences: 0,
            is_unseen,
        });
    }

    pub fn take_events(&mut self) -> Vec<AlertEvent> {
        std::mem::take(&mut self.events)
    }

    /// Kind, time and a count within the same instant: the same input gives the same ids.
    fn new_id(&mut self, kind: AlertKind, now: Timestamp) -> String {
        if self.numbered.0 != now {
            self.numbered = (now, BTreeMap::new());
        }
        let next = self.numbered.1.entry(kind).or_default();
        let number = *next;
        *next += 1;
        let kind = serde_json::to_value(kind).ok();
        let kind = kind.as_ref().and_then(Value::as_str).unwrap_or("alert");
        format!("{kind}-{}-{number}", now.strftime("%Y%m%dT%H%M%S%6fZ"))
    }
}

impl Finding {
    fn write_to(self, alert: &mut Alert) {
        alert.severity = self.severity;
        alert.x_m = self.x_m;
        alert.y_m = self.y_m;
        alert.cov_m2 = self.cov_m2;
        alert.claimed = self.claimed;
        alert.evidence = self.evidence;
    }
}

fn note_recurrences(alert: &mut Alert, recurrences: u32) {
    if recurrences > 0
        && let Value::Object(evidence) = &mut alert.evidence
    {
        evidence.insert("recurrences".into(), recurrences.into());
    }
}
