//! One alert a cause within the cool-down: decides whether an event is sent now, later or never. Pure: times are
//! [`Duration`]s on a clock that never jumps.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::journal::Waiting;
use crate::monitor::{Alert, AlertEvent, AlertEventKind, Severity};

/// Causes remembered; beyond that every event is sent.
const MOST_TOLD: usize = 10_000;

/// What becomes of an event's delivery, and of those of its alert that were held back.
#[derive(Debug, PartialEq)]
pub(super) enum Ruling {
    Send(Vec<Waiting>),
    Hold,
    Withhold(Vec<Waiting>),
}

/// A cause that the receiver was notified of.
#[derive(Debug)]
struct Told {
    alert: Alert,
    at: Duration,
    /// The highest severity sent for it since.
    severity: Severity,
    has_cleared: bool,
}

/// An alert whose cause the receiver was notified of within the cool-down.
#[derive(Debug)]
struct Held {
    before: Told,
    alert: Alert,
    deliveries: Vec<Waiting>,
}

/// One endpoint's cool-down.
#[derive(Debug)]
pub(super) struct CoolDown {
    period: Duration,
    told: Vec<Told>,
    /// By alert.
    held: BTreeMap<String, Held>,
}

impl Told {
    fn now(alert: &Alert, now: Duration) -> Self {
        Self {
            alert: alert.clone(),
            at: now,
            severity: alert.severity,
            has_cleared: false,
        }
    }
}

impl CoolDown {
    pub(super) fn new(period: Duration) -> Self {
        Self {
            period,
            told: Vec::new(),
            held: BTreeMap::new(),
        }
    }

    pub(super) fn set_period(&mut self, period: Duration) {
        self.period = period;
    }

    /// Whether there is anything to judge.
    pub(super) fn is_off(&self) -> bool {
        self.period.is_zero()
    }

    /// Decides on a new event's delivery.
    pub(super) fn judge(&mut self, delivery: Waiting, event: &AlertEvent, now: Duration) -> Ruling {
        let alert = &event.alert;
        match event.told_as() {
            AlertEventKind::Raised => self.raised(delivery, alert, now),
            AlertEventKind::Updated => self.updated(delivery, alert, now),
            AlertEventKind::Cleared => self.cleared(delivery, alert, now),
            AlertEventKind::Acknowledged | AlertEventKind::Unacknowledged | AlertEventKind::Reported => {
                match self.held.get_mut(&alert.id) {
                    Some(held) => {
                        held.deliveries.push(delivery);
                        Ruling::Hold
                    }
                    None => Ruling::Send(vec![delivery]),
                }
            }
        }
    }

    fn raised(&mut self, delivery: Waiting, alert: &Alert, now: Duration) -> Ruling {
        let period = self.period;
        self.told.retain(|t| !t.has_cleared || now < t.at + period);
        // Two at once are two causes, however near to each other.
        let same = self
            .told
            .iter()
            .position(|t| t.has_cleared && t.alert.has_cause_of(alert));
        let before = same.map(|k| self.told.swap_remove(k));
        match before {
            // Some requests for it were made before a restart: it must go on.
            Some(before) if alert.severity <= before.severity && delivery.attempts == 0 => {
                let held = Held {
                    before,
                    alert: alert.clone(),
                    deliveries: vec![delivery],
                };
                self.held.insert(alert.id.clone(), held);
                Ruling::Hold
            }
            _ => {
                self.tell(alert, now);
                Ruling::Send(vec![delivery])
            }
        }
    }

    fn updated(&mut self, delivery: Waiting, alert: &Alert, now: Duration) -> Ruling {
        if let Some(mut held) = self.held.remove(&alert.id) {
            held.deliveries.push(delivery);
            if alert.severity > held.before.severity {
                self.tell(alert, now);
                return Ruling::Send(held.deliveries);
            }
            self.held.insert(alert.id.clone(), held);
            return Ruling::Hold;
        }
        if let Some(told) = self.told.iter_mut().find(|t| t.alert.id == alert.id) {
            told.severity = told.severity.max(alert.severity);
        }
        Ruling::Send(vec![delivery])
    }

    fn cleared(&mut self, delivery: Waiting, alert: &Alert, now: Duration) -> Ruling {
        if let Some(mut held) = self.held.remove(&alert.id) {
            held.deliveries.push(delivery);
            self.told.push(held.before);
            return Ruling::Withhold(held.deliveries);
        }
        if let Some(k) = self.told.iter().position(|t| t.alert.id == alert.id) {
            if now < self.told[k].at + self.period {
                self.told[k].has_cleared = true;
                // Where it was last seen is where it is known by.
                self.told[k].alert = alert.clone();
            } else {
                self.told.swap_remove(k);
            }
        }
        Ruling::Send(vec![delivery])
    }

    fn tell(&mut self, alert: &Alert, now: Duration) {
        if self.told.len() < MOST_TOLD {
            self.told.push(Told::now(alert, now));
        }
    }

    /// Deliveries whose cool-down is over and whose cause is still there.
    pub(super) fn due(&mut self, now: Duration) -> Vec<Waiting> {
        let period = self.period;
        let over: Vec<String> = self
            .held
            .iter()
            .filter(|(_, held)| now >= held.before.at + period)
            .map(|(id, _)| id.clone())
            .collect();
        let mut deliveries = Vec::new();
        for held in over.iter().filter_map(|id| self.held.remove(id)).collect::<Vec<_>>() {
            self.tell(&held.alert, now);
            deliveries.extend(held.deliveries);
        }
        deliveries
    }

    /// When [`CoolDown::due`] is worth asking again.
    pub(super) fn wake_at(&self) -> Option<Duration> {
        self.held.values().map(|held| held.before.at + self.period).min()
    }

    /// Deliveries held back.
    pub(super) fn len(&self) -> usize {
        self.held.values().map(|held| held.deliveries.len()).sum()
    }

    pub(super) fn holds(&self, seq: u64) -> bool {
        self.held
            .values()
            .any(|held| held.deliveries.iter().any(|d| d.seq == seq))
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use serde_json::json;

    use super::*;
    use crate::monitor::{AlertKind, AlertSource, AlertState};

    fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    /// A cool-down of a minute, asked about one event after another.
    struct Asked {
        cool_down: CoolDown,
        seq: u64,
    }

    impl Asked {
        fn new() -> Self {
            Self {
                cool_down: CoolDown::new(s(60)),
                seq: 0,
            }
        }

        /// What becomes of the event: the numbers of what is sent or withheld.
        fn ask(&mut self, event: AlertEventKind, id: &str, severity: Severity, place: [f64; 2], now: u64) -> String {
            self.seq += 1;
            let delivery = Waiting {
                seq: self.seq,
                endpoint: "e".into(),
                alert: id.into(),
                recorded_at: Timestamp::UNIX_EPOCH,
                step: 0,
                attempts: 0,
                next_at: Timestamp::UNIX_EPOCH,
            };
            let alert = Alert {
                id: id.into(),
                kind: AlertKind::UnclaimedEmitter,
                severity,
                state: AlertState::Open,
                raised_at: Timestamp::UNIX_EPOCH,
                cleared_at: None,
                user: None,
                x_m: Some(place[0]),
                y_m: Some(place[1]),
                z_m: Some(0.0),
                geodetic: None,
                cov_m2: None,
                claimed: None,
                evidence: json!({}),
                source: AlertSource {
                    kind: "replay".into(),
                    frame: 0,
                    file: None,
                },
                zone: None,
                webhooks: None,
                maintenance: None,
                acknowledgement: None,
                station: None,
            };
            let numbers = |rows: Vec<Waiting>| rows.iter().map(|r| r.seq.to_string()).collect::<Vec<_>>().join(" ");
            match self.cool_down.judge(delivery, &AlertEvent::new(event, alert), s(now)) {
                Ruling::Send(rows) => format!("send {}", numbers(rows)),
                Ruling::Hold => "hold".into(),
                Ruling::Withhold(rows) => format!("withhold {}", numbers(rows)),
            }
        }

        fn due(&mut self, now: u64) -> Vec<u64> {
            self.cool_down.due(s(now)).iter().map(|row| row.seq).collect()
        }
    }

    use AlertEventKind::{Cleared, Raised, Updated};
    use Severity::{Critical, Warning};

    const HERE: [f64; 2] = [1.0, 2.0];
    const THERE: [f64; 2] = [30.0, 2.0];

    #[test]
    fn a_cause_that_comes_back_and_goes_is_told_of_once() {
        let mut asked = Asked::new();
        assert_eq!(asked.ask(Raised, "a", Warning, HERE, 0), "send 1");
        assert_eq!(asked.ask(Cleared, "a", Warning, HERE, 5), "send 2");
        assert_eq!(asked.ask(Raised, "b", Warning, [3.0, 2.0], 10), "hold");
        assert_eq!(asked.cool_down.wake_at(), Some(s(60)));
        assert!(asked.due(59).is_empty());
        assert_eq!(asked.ask(Cleared, "b", Warning, HERE, 20), "withhold 3 4");
        assert_eq!(asked.ask(Raised, "c", Warning, HERE, 30), "hold");
        assert_eq!(asked.ask(Raised, "d", Warning, THERE, 30), "send 6", "another place");
        // Still there when the cool-down is over: told of then, and its end at once.
        assert_eq!(asked.due(60), [5]);
        assert_eq!((asked.cool_down.len(), asked.cool_down.wake_at()), (0, None));
        assert_eq!(asked.ask(Cleared, "c", Warning, HERE, 70), "send 7");
        // A new cool-down counts from what was told last.
        assert_eq!(asked.ask(Raised, "f", Warning, HERE, 119), "hold");
        assert_eq!(asked.ask(Cleared, "f", Warning, HERE, 119), "withhold 8 9");
        assert_eq!(asked.ask(Raised, "g", Warning, HERE, 120), "send 10");
    }

    #[test]
    fn what_grows_worse_is_told_of_at_once_and_in_order() {
        let mut asked = Asked::new();
        asked.ask(Raised, "a", Warning, HERE, 0);
        asked.ask(Cleared, "a", Warning, HERE, 1);
        assert_eq!(asked.ask(Raised, "b", Warning, HERE, 2), "hold");
        assert_eq!(asked.ask(Updated, "b", Critical, HERE, 12), "send 3 4");
        assert_eq!(asked.ask(Cleared, "b", Critical, HERE, 13), "send 5");
        // As bad as what was told: not worse.
        assert_eq!(asked.ask(Raised, "c", Critical, HERE, 14), "hold");
        let mut fresh = Asked::new();
        fresh.ask(Raised, "a", Warning, HERE, 0);
        fresh.ask(Cleared, "a", Warning, HERE, 1);
        assert_eq!(fresh.ask(Raised, "b", Critical, HERE, 2), "send 3");
    }

    #[test]
    fn a_second_beam_beside_one_that_stands_is_another_cause() {
        let mut asked = Asked::new();
        assert_eq!(asked.ask(Raised, "a", Warning, HERE, 0), "send 1");
        assert_eq!(asked.ask(Raised, "b", Warning, [4.0, 2.0], 1), "send 2");
        asked.ask(Cleared, "a", Warning, HERE, 2);
        // One that came back takes the place of the one that went; a third does not.
        assert_eq!(asked.ask(Raised, "c", Warning, HERE, 3), "hold");
        assert_eq!(asked.ask(Raised, "d", Warning, HERE, 3), "send 5");
    }
}
