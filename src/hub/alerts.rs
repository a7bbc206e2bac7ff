//! The alerts of all access points as one list: one alert for one cause, whoever reports it, and the hub's own.

use std::collections::{BTreeMap, HashMap, HashSet};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::geo::Geodetic;
use crate::monitor::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity, StationName,
    Withdrawal,
};
use crate::word::word;

/// Key of the evidence that lists the stations' own alerts.
const REPORTED: &str = "reported_by";

/// A station's own alert.
type Member = (StationName, String);

/// What only the hub can see.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum OwnCause {
    StationLost(StationName),
    UserInTwoPlaces(String),
}

/// Place and evidence of one of the hub's own alerts.
#[derive(Clone, Debug, Default)]
pub struct Finding {
    pub place_m: Option<[f64; 3]>,
    pub geodetic: Option<Geodetic>,
    pub evidence: Value,
}

#[derive(Debug, Default)]
pub struct HubAlerts {
    /// By the hub's ids.
    open: BTreeMap<String, Open>,
    own: BTreeMap<OwnCause, String>,
    of_member: HashMap<Member, String>,
    /// Alerts that another station's sight explains: they are not passed on.
    withheld: HashSet<Member>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Open {
    alert: Alert,
    members: Vec<Member>,
}

/// The list, in a recording.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SavedAlerts {
    open: Vec<Open>,
    withheld: Vec<Member>,
}

impl HubAlerts {
    /// Goes on with the alerts that an earlier run left open.
    pub fn restore(&mut self, alerts: Vec<Alert>) {
        for alert in alerts {
            let members: Vec<Member> = serde_json::from_value(alert.evidence[REPORTED].clone()).unwrap_or_default();
            self.insert(Open { alert, members });
        }
    }

    fn insert(&mut self, open: Open) {
        let Open { alert, members } = &open;
        for member in members {
            self.of_member.insert(member.clone(), alert.id.clone());
        }
        let cause = match (alert.kind, &alert.station, &alert.user) {
            (AlertKind::StationLost, Some(name), _) => Some(OwnCause::StationLost(name.clone())),
            (AlertKind::UserInTwoPlaces, _, Some(user)) => Some(OwnCause::UserInTwoPlaces(user.clone())),
            _ => None,
        };
        if let Some(cause) = cause {
            self.own.insert(cause, alert.id.clone());
        }
        self.open.insert(alert.id.clone(), open);
    }

    pub fn saved(&self) -> SavedAlerts {
        let mut withheld: Vec<Member> = self.withheld.iter().cloned().collect();
        withheld.sort();
        SavedAlerts {
            open: self.open.values().cloned().collect(),
            withheld,
        }
    }

    pub fn resume(saved: SavedAlerts) -> Self {
        let mut alerts = Self {
            withheld: saved.withheld.into_iter().collect(),
            ..Self::default()
        };
        for open in saved.open {
            alerts.insert(open);
        }
        alerts
    }

    /// Number of alerts that are not cleared, by kind.
    pub fn open_by_kind(&self) -> BTreeMap<AlertKind, u64> {
        let mut counts = BTreeMap::new();
        for open in self.open.values() {
            *counts.entry(open.alert.kind).or_default() += 1;
        }
        counts
    }

    /// Takes one event of a station's alert; gives what it means for the list, if anything. `is_seen_elsewhere` says whether another
    /// station sees a user now, `track_now` where a station's track is now, m.
    pub fn take(
        &mut self,
        name: &StationName,
        event: AlertEvent,
        is_seen_elsewhere: impl Fn(&str) -> bool,
        track_now: impl Fn(&StationName, u64) -> Option<[f64; 2]>,
    ) -> Option<AlertEvent> {
        let member = (name.clone(), event.alert.id.clone());
        if event.event == AlertEventKind::Cleared {
            return self.clear_member(&member, event.alert);
        }
        if self.withheld.contains(&member) {
            return None;
        }
        match self.of_member.get(&member).cloned() {
            Some(id) => self.update(&id, &member, event),
            None => self.add(member, event.alert, is_seen_elsewhere, track_now),
        }
    }

    fn add(
        &mut self,
        member: Member,
        alert: Alert,
        is_seen_elsewhere: impl Fn(&str) -> bool,
        track_now: impl Fn(&StationName, u64) -> Option<[f64; 2]>,
    ) -> Option<AlertEvent> {
        let is_unseen = alert.kind == AlertKind::UserUnseen;
        if is_unseen && alert.user.as_deref().is_some_and(is_seen_elsewhere) {
            self.withheld.insert(member);
            return None;
        }
        let is_same = |open: &&mut Open| is_shared(open, &member.0, &alert, &track_now);
        if let Some(open) = self.open.values_mut().find(is_same) {
            self.of_member.insert(member.clone(), open.alert.id.clone());
            open.members.push(member);
            note_reporters(&mut open.alert, &open.members);
            // Either way the list of who reports it is in the journal, from which a later run goes on.
            if alert.severity <= open.alert.severity {
                return Some(event(AlertEventKind::Reported, &open.alert));
            }
            open.alert.severity = alert.severity;
            return Some(event(AlertEventKind::Updated, &open.alert));
        }
        let members = vec![member.clone()];
        let alert = adopted(&member, alert, &members);
        let raised = event(AlertEventKind::Raised, &alert);
        self.of_member.insert(member, alert.id.clone());
        self.open.insert(alert.id.clone(), Open { alert, members });
        Some(raised)
    }

    fn update(&mut self, id: &str, member: &Member, update: AlertEvent) -> Option<AlertEvent> {
        let open = self.open.get_mut(id)?;
        if open.members.first() != Some(member) {
            let is_worse = update.alert.severity > open.alert.severity;
            return is_worse.then(|| {
                open.alert.severity = update.alert.severity;
                event(AlertEventKind::Updated, &open.alert)
            });
        }
        let mut alert = adopted(member, update.alert, &open.members);
        // Whoever raised it may have cleared it since: it stays the alert that receivers know.
        alert.id = id.to_owned();
        alert.raised_at = open.alert.raised_at;
        alert.severity = alert.severity.max(open.alert.severity);
        if update.event == AlertEventKind::Updated {
            // What was acknowledged here stays so.
            alert.acknowledgement = alert.acknowledgement.or(open.alert.acknowledgement.take());
            if open.alert.state == AlertState::Acknowledged {
                alert.state = AlertState::Acknowledged;
            }
        }
        open.alert = alert;
        Some(AlertEvent {
            released: update.released,
            ..event(update.event, &open.alert)
        })
    }

    fn clear_member(&mut self, member: &Member, alert: Alert) -> Option<AlertEvent> {
        if self.withheld.remove(member) {
            return None;
        }
        let Some(id) = self.of_member.remove(member) else {
            // Raised before this hub began to listen: its end is history all the same.
            return Some(event(
                AlertEventKind::Cleared,
                &adopted(member, alert, std::slice::from_ref(member)),
            ));
        };
        let open = self.open.get_mut(&id)?;
        open.members.retain(|other| other != member);
        if !open.members.is_empty() {
            open.alert.station = open.members.first().map(|(name, _)| name.clone());
            note_reporters(&mut open.alert, &open.members);
            return Some(event(AlertEventKind::Reported, &open.alert));
        }
        let mut open = self.open.remove(&id)?;
        open.alert.state = AlertState::Cleared;
        open.alert.cleared_at = alert.cleared_at;
        Some(event(AlertEventKind::Cleared, &open.alert))
    }

    /// Raises one of the hub's own alerts, once.
    pub fn raise(&mut self, cause: OwnCause, finding: Finding, now: Timestamp) -> Option<AlertEvent> {
        if self.own.contains_key(&cause) {
            return None;
        }
        let (kind, user, station) = match &cause {
            OwnCause::StationLost(name) => (AlertKind::StationLost, None, Some(name.clone())),
            OwnCause::UserInTwoPlaces(user) => (AlertKind::UserInTwoPlaces, Some(user.clone()), None),
        };
        let about = station.as_ref().map(|name| format!(".{name}")).unwrap_or_default();
        let stem = format!("hub{about}.{}-{}", word(kind), now.strftime("%Y%m%dT%H%M%S%6fZ"));
        let free = |n: &u32| !self.open.contains_key(&format!("{stem}-{n}"));
        let number = (0..).find(free).expect("some number is free");
        let alert = Alert {
            id: format!("{stem}-{number}"),
            kind,
            severity: Severity::Critical,
            state: AlertState::Open,
            raised_at: now,
            cleared_at: None,
            user,
            x_m: finding.place_m.map(|p| p[0]),
            y_m: finding.place_m.map(|p| p[1]),
            z_m: finding.place_m.map(|p| p[2]),
            geodetic: finding.geodetic,
            cov_m2: None,
            claimed: None,
            evidence: finding.evidence,
            source: AlertSource {
                kind: "fleet".to_owned(),
                frame: 0,
                file: None,
            },
            zone: None,
            webhooks: None,
            maintenance: None,
            acknowledgement: None,
            station,
        };
        let raised = event(AlertEventKind::Raised, &alert);
        self.own.insert(cause, alert.id.clone());
        let members = Vec::new();
        self.open.insert(alert.id.clone(), Open { alert, members });
        Some(raised)
    }

    /// Clears one of the hub's own alerts, where it is open.
    pub fn clear(&mut self, cause: &OwnCause, now: Timestamp) -> Option<AlertEvent> {
        let mut open = self.open.remove(&self.own.remove(cause)?)?;
        open.alert.state = AlertState::Cleared;
        open.alert.cleared_at = Some(now);
        Some(event(AlertEventKind::Cleared, &open.alert))
    }

    /// Open conflicts of users and lost stations.
    pub fn own_causes(&self) -> Vec<OwnCause> {
        self.own.keys().cloned().collect()
    }

    /// An alert that is open.
    pub fn open(&self, id: &str) -> Option<&Alert> {
        self.open.get(id).map(|open| &open.alert)
    }

    /// The event, where it changes anything.
    pub fn acknowledge(&mut self, id: &str, note: Acknowledgement) -> Option<AlertEvent> {
        let alert = &mut self.open.get_mut(id)?.alert;
        let changed = alert.acknowledge(note);
        changed.then(|| event(AlertEventKind::Acknowledged, alert))
    }

    pub fn withdraw(&mut self, id: &str, withdrawal: Withdrawal) -> Option<AlertEvent> {
        let alert = &mut self.open.get_mut(id)?.alert;
        let changed = alert.withdraw(withdrawal);
        changed.then(|| event(AlertEventKind::Unacknowledged, alert))
    }
}

/// Whether an alert of one station is open already for another station's, whose beam may have gone on since its alert was told.
fn is_shared(
    open: &Open,
    name: &StationName,
    alert: &Alert,
    track_now: impl Fn(&StationName, u64) -> Option<[f64; 2]>,
) -> bool {
    let is_of_place = matches!(
        alert.kind,
        AlertKind::UnclaimedEmitter | AlertKind::UserUnseen | AlertKind::PositionMismatch
    );
    let is_of_another = !open.members.is_empty() && open.members.iter().all(|(other, _)| other != name);
    let here = || {
        let track = open.alert.evidence["track"].as_u64()?;
        let (other, _) = open.members.first()?;
        let [x_m, y_m] = track_now(other, track)?;
        let mut moved = open.alert.clone();
        (moved.x_m, moved.y_m) = (Some(x_m), Some(y_m));
        Some(moved)
    };
    is_of_place
        && is_of_another
        && (open.alert.has_cause_of(alert) || here().is_some_and(|moved| moved.has_cause_of(alert)))
}

/// A station's alert under the hub's id.
fn adopted(member: &Member, mut alert: Alert, members: &[Member]) -> Alert {
    let (name, id) = member;
    alert.id = format!("{name}.{id}");
    alert.station = Some(name.clone());
    // The station's zones name webhooks of its own; its maintenance is the hub's too.
    alert.webhooks = alert.maintenance.is_some().then(Vec::new);
    note_reporters(&mut alert, members);
    alert
}

/// Evidence is an object or null; a station may send anything.
fn note_reporters(alert: &mut Alert, members: &[Member]) {
    if !alert.evidence.is_object() {
        alert.evidence = json!({});
    }
    alert.evidence[REPORTED] = json!(members);
}

fn event(event: AlertEventKind, alert: &Alert) -> AlertEvent {
    AlertEvent::new(event, alert.clone())
}

#[cfg(test)]
#[path = "alerts_test.rs"]
mod tests;
