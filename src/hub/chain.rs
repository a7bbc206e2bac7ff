//! What the hub makes of what it hears: messages and times in, alert events out. It reads no clock, so that a review of what a hub
//! has heard gives what that hub said.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::alerts::{Finding, HubAlerts, OwnCause, SavedAlerts};
use super::conflicts::Conflicts;
use super::picture::Picture;
use super::stations::{Refused, SavedStation, Sighting, Stations};
use crate::api::StationStatus;
use crate::config::Config;
use crate::fleet::Topic;
use crate::fleet::message::{AlertMessage, HealthMessage, PoseMessage, PositionsMessage};
use crate::journal::Origin;
use crate::monitor::{Acknowledgement, Alert, AlertEvent, AlertKind, StationName, Withdrawal};
use crate::time::seconds;

/// What a config says of the chain.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    pub lost_after_s: f64,
    pub tolerated_m: f64,
}

impl Settings {
    pub fn new(config: &Config) -> Self {
        Self {
            lost_after_s: config.fleet.lost_after_s,
            tolerated_m: config.monitor.tolerated_distance_m,
        }
    }
}

/// What the chain is given.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Heard {
    Alert(Box<AlertMessage>),
    Positions(PositionsMessage),
    Pose(Box<PoseMessage>),
    Health(HealthMessage),
    Acknowledge {
        id: String,
        note: Acknowledgement,
    },
    Withdraw {
        id: String,
        withdrawal: Withdrawal,
    },
    /// Time goes on: silence and conflicts are judged.
    Tick,
}

impl Heard {
    /// What was heard of whom; `None` where no message was.
    pub fn said(&self) -> Option<(Topic, StationName)> {
        match self {
            Self::Alert(message) => Some((Topic::Alert, message.name.clone())),
            Self::Positions(message) => Some((Topic::Positions, message.name.clone())),
            Self::Pose(message) => Some((Topic::Pose, message.name.clone())),
            Self::Health(message) => Some((Topic::Health, message.name.clone())),
            Self::Acknowledge { .. } | Self::Withdraw { .. } | Self::Tick => None,
        }
    }
}

/// An event of the hub's list.
#[derive(Clone, Debug)]
pub struct Taken {
    pub event: AlertEvent,
    pub at: Timestamp,
    /// Its place in its station's journal.
    pub origin: Option<Origin>,
}

/// What follows from one thing heard.
#[derive(Debug, Default)]
pub struct Outcome {
    pub taken: Vec<Taken>,
    /// Why a message changes nothing; of an alert, why its station is not shown.
    pub refused: Option<Refused>,
}

pub struct Chain {
    settings: Settings,
    started_at: Timestamp,
    alerts: HubAlerts,
    conflicts: Conflicts,
    stations: Stations,
    /// The last event taken from each station's journal.
    taken: BTreeMap<String, u64>,
}

/// What alerts depend on, where a recording begins.
#[derive(Debug, Serialize, Deserialize)]
pub struct SavedChain {
    started_at: Timestamp,
    alerts: SavedAlerts,
    conflicts: Conflicts,
    stations: Vec<SavedStation>,
    taken: BTreeMap<String, u64>,
}

impl Chain {
    /// Goes on with what an earlier run left open, and from where it had taken each station's events.
    pub fn new(settings: Settings, open: Vec<Alert>, taken: BTreeMap<String, u64>, started_at: Timestamp) -> Self {
        let mut alerts = HubAlerts::default();
        alerts.restore(open);
        let mut conflicts = Conflicts::default();
        let mut stations = Stations::default();
        // One that has gone silent while no hub ran is missed too.
        for name in taken.keys().filter_map(|source| station_of(source)) {
            // More stations than are kept: those are shown when they speak.
            let _ = stations.take_sign(&name, started_at);
        }
        for cause in alerts.own_causes() {
            match cause {
                OwnCause::UserInTwoPlaces(user) => conflicts.restore(std::iter::once(user), started_at),
                // It is lost until it says something.
                OwnCause::StationLost(name) => drop(stations.take_sign(&name, Timestamp::UNIX_EPOCH)),
            }
        }
        Self {
            settings,
            started_at,
            alerts,
            conflicts,
            stations,
            taken,
        }
    }

    pub fn saved(&self) -> SavedChain {
        SavedChain {
            started_at: self.started_at,
            alerts: self.alerts.saved(),
            conflicts: self.conflicts.clone(),
            stations: self.stations.saved(),
            taken: self.taken.clone(),
        }
    }

    pub fn resume(settings: Settings, saved: SavedChain) -> Self {
        Self {
            settings,
            started_at: saved.started_at,
            alerts: HubAlerts::resume(saved.alerts),
            conflicts: saved.conflicts,
            stations: Stations::resume(saved.stations),
            taken: saved.taken,
        }
    }

    /// Forgets which events were taken, after some of them were lost to the journal: they come again.
    pub fn take_again_from(&mut self, taken: BTreeMap<String, u64>) {
        self.taken = taken;
    }

    pub fn take(&mut self, heard: Heard, now: Timestamp) -> Outcome {
        let own = |event: Option<AlertEvent>| Outcome {
            taken: event
                .into_iter()
                .map(|event| Taken {
                    event,
                    at: now,
                    origin: None,
                })
                .collect(),
            refused: None,
        };
        let signed = |taken: Result<(), Refused>| Outcome {
            refused: taken.err(),
            ..Outcome::default()
        };
        match heard {
            Heard::Alert(message) => self.take_alert(*message, now),
            Heard::Positions(message) => signed(self.stations.take_positions(message, now)),
            Heard::Pose(message) => signed(self.stations.take_pose(*message, now)),
            Heard::Health(message) => signed(self.stations.take_health(message, now)),
            Heard::Acknowledge { id, note } => own(self.alerts.acknowledge(&id, note)),
            Heard::Withdraw { id, withdrawal } => own(self.alerts.withdraw(&id, withdrawal)),
            Heard::Tick => self.tick(now),
        }
    }

    fn take_alert(&mut self, message: AlertMessage, now: Timestamp) -> Outcome {
        let source = source_of(&message.name, &message.journal);
        if self.taken.get(&source).is_some_and(|&last| message.seq <= last) {
            return Outcome {
                refused: Some(Refused::Repeated),
                ..Outcome::default()
            };
        }
        self.taken.insert(source.clone(), message.seq);
        let refused = self.stations.take_sign(&message.name, now).err();
        let (stations, name) = (&self.stations, &message.name);
        let is_seen_elsewhere = |user: &str| stations.is_seen_elsewhere(user, name, now);
        let track_now = |name: &StationName, track| stations.track(name, track, now);
        let event = self.alerts.take(name, message.event, is_seen_elsewhere, track_now);
        let origin = Origin {
            source: source.into(),
            seq: message.seq,
        };
        let taken = event.map(|event| Taken {
            event,
            at: message.at,
            origin: Some(origin),
        });
        Outcome {
            taken: taken.into_iter().collect(),
            refused,
        }
    }

    fn tick(&mut self, now: Timestamp) -> Outcome {
        let mut events: Vec<Option<AlertEvent>> = Vec::new();
        let lost_after_s = self.settings.lost_after_s;
        let uptime = seconds(self.started_at, now);
        for (name, is_lost, last_seen) in self.stations.lost(now, lost_after_s) {
            let cause = OwnCause::StationLost(name.clone());
            // Just started, the hub has not had the time to hear of anybody.
            if is_lost && uptime > lost_after_s {
                let evidence = json!({ "last_seen_at": last_seen, "lost_after_s": lost_after_s });
                let finding = Finding {
                    evidence,
                    ..Finding::default()
                };
                events.push(self.alerts.raise(cause, finding, now));
            } else if !is_lost {
                events.push(self.alerts.clear(&cause, now));
            }
        }
        let found = self.stations.conflicts(now, self.settings.tolerated_m);
        let (standing, over) = self.conflicts.step(found, now);
        for (user, places) in standing {
            let finding = finding(&places);
            events.push(self.alerts.raise(OwnCause::UserInTwoPlaces(user), finding, now));
        }
        for user in over {
            events.push(self.alerts.clear(&OwnCause::UserInTwoPlaces(user), now));
        }
        let taken = |event| Taken {
            event,
            at: now,
            origin: None,
        };
        Outcome {
            taken: events.into_iter().flatten().map(taken).collect(),
            refused: None,
        }
    }

    /// An alert of the list that is open.
    pub fn alert(&self, id: &str) -> Option<&Alert> {
        self.alerts.open(id)
    }

    pub fn open_by_kind(&self) -> BTreeMap<AlertKind, u64> {
        self.alerts.open_by_kind()
    }

    pub fn picture(&mut self, now: Timestamp) -> Picture {
        self.stations.picture(now, self.settings.tolerated_m)
    }

    pub fn statuses(&self, now: Timestamp) -> Vec<StationStatus> {
        self.stations.statuses(now, self.settings.lost_after_s)
    }
}

/// A station's journal among all origins of events.
fn source_of(name: &StationName, journal: &str) -> String {
    format!("{name}/{journal}")
}

fn station_of(source: &str) -> Option<StationName> {
    let (name, _) = source.split_once('/')?;
    let (site, station) = name.split_once('.')?;
    Some(StationName {
        site: site.to_owned(),
        station: station.to_owned(),
    })
}

fn finding([a, b]: &[Sighting; 2]) -> Finding {
    let place = |s: &Sighting| {
        let StationName { site, station } = &s.name;
        json!({ "site": site, "station": station, "x_m": s.x_m, "y_m": s.y_m, "by": if s.is_seen { "beam" } else { "claim" } })
    };
    let seen = if a.is_seen { a } else { b };
    Finding {
        place_m: Some([seen.x_m, seen.y_m, seen.z_m]),
        geodetic: seen.geodetic,
        evidence: json!({ "places": [place(a), place(b)], "distance_m": (a.x_m - b.x_m).hypot(a.y_m - b.y_m) }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::AlertEventKind;

    const SETTINGS: Settings = Settings {
        lost_after_s: 10.0,
        tolerated_m: 5.0,
    };

    fn at(s: i64) -> Timestamp {
        Timestamp::from_second(1_000_000 + s).unwrap()
    }

    fn name(station: &str) -> StationName {
        StationName {
            site: "harbour".to_owned(),
            station: station.to_owned(),
        }
    }

    fn health(station: &str, s: i64) -> Heard {
        Heard::Health(HealthMessage {
            version: crate::fleet::message::VERSION,
            name: name(station),
            time: at(s),
            status: serde_json::Value::Null,
            alerts_waiting: 0,
        })
    }

    /// A chain that has known two stations before it began, of which one speaks.
    fn started() -> Chain {
        let taken = ["a", "b"].map(|station| (source_of(&name(station), "j"), 7));
        let mut chain = Chain::new(SETTINGS, Vec::new(), taken.into(), at(0));
        assert!(chain.take(Heard::Tick, at(9)).taken.is_empty());
        assert!(chain.take(health("a", 9), at(9)).refused.is_none());
        chain
    }

    #[test]
    fn a_station_that_fell_silent_while_no_hub_ran_is_missed() {
        let told = started().take(Heard::Tick, at(11)).taken;
        let [lost] = told.as_slice() else { panic!("{told:?}") };
        assert_eq!(
            (lost.event.event, lost.event.alert.kind),
            (AlertEventKind::Raised, AlertKind::StationLost)
        );
        assert_eq!(lost.event.alert.station, Some(name("b")));
    }

    #[test]
    fn a_chain_that_was_saved_goes_on_as_it_would_have() {
        let mut chain = started();
        chain.take(Heard::Tick, at(11));
        let saved = serde_json::to_string(&chain.saved()).unwrap();
        let mut again = Chain::resume(SETTINGS, serde_json::from_str(&saved).unwrap());
        for (s, heard) in [(12, Some("b")), (13, None), (25, None)] {
            let heard = || heard.map_or(Heard::Tick, |station| health(station, s));
            let [told, retold] = [&mut chain, &mut again].map(|chain| format!("{:?}", chain.take(heard(), at(s))));
            assert_eq!(told, retold);
        }
        assert_eq!(again.open_by_kind()[&AlertKind::StationLost], 2);
    }
}
