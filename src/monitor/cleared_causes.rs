//! Causes whose alert has cleared: whether a new one is the same again, and how long an alert is held open for one that comes and goes.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::alert::{AlertKind, SAME_PLACE_M};
use super::finding::Cause;
use crate::time::seconds;

/// Absence after which an alert clears at the first occurrence of its cause, s. Longer keeps alerts open after their cause
/// has gone; shorter splits one cause into several alerts. Doubled at each recurrence, so that only a cause's first
/// minute depends on it. Not tuned.
const CLEAR_S: f64 = 1.0;
/// Cleared causes that are remembered for their recurrences; bounds memory under a flood of alerts.
const MAX_CLEARED: usize = 10_000;

/// Causes that cleared lately.
#[derive(Debug)]
pub(super) struct ClearedCauses {
    causes: BTreeMap<Cause, Cleared>,
    /// Absence for which a cause that comes back is the same, s.
    pub cool_down_s: f64,
}

#[derive(Clone, Copy, Debug)]
struct Cleared {
    at: Timestamp,
    recurrences: u32,
    place: Option<[f64; 2]>,
}

impl ClearedCauses {
    pub fn new(cool_down_s: f64) -> Self {
        Self {
            causes: BTreeMap::new(),
            cool_down_s,
        }
    }

    /// Absence that clears an alert whose cause has come back so often, s: at most the cool-down.
    pub fn hold_s(&self, recurrences: u32) -> f64 {
        (CLEAR_S * 2f64.powi(recurrences.min(20) as i32)).min(self.cool_down_s)
    }

    /// Remembers a cause that has cleared. `place`: where its alert was, m.
    pub fn push(&mut self, cause: Cause, recurrences: u32, place: Option<[f64; 2]>, now: Timestamp) {
        let cool_down_s = self.cool_down_s;
        if self.causes.len() >= MAX_CLEARED {
            self.causes.retain(|_, c| seconds(c.at, now) <= cool_down_s);
        }
        if self.causes.len() < MAX_CLEARED {
            let cleared = Cleared {
                at: now,
                recurrences,
                place,
            };
            self.causes.insert(cause, cleared);
        }
    }

    /// Takes a cause that comes up again: how often it had come back before it cleared, if that was within the cool-down. A beam
    /// that comes on again has a new track: it is recognised by its place.
    pub fn take(&mut self, cause: &Cause, place: Option<[f64; 2]>, now: Timestamp) -> Option<u32> {
        let cool_down_s = self.cool_down_s;
        let is_recent = |c: &Cleared| seconds(c.at, now) <= cool_down_s;
        let is_near = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < SAME_PLACE_M;
        let same = match (cause, place) {
            (Cause::Track(_), Some(here)) => self
                .causes
                .iter()
                .filter(|(other, c)| matches!(other, Cause::Track(_)) && is_recent(c))
                .find(|(_, c)| c.place.is_some_and(|there| is_near(there, here)))
                .map(|(other, _)| other.clone()),
            _ => Some(cause.clone()),
        };
        self.causes.remove(&same?).filter(is_recent).map(|c| c.recurrences)
    }

    /// Users with an alert of this kind that cleared within the cool-down.
    pub fn users_with(&self, kind: AlertKind, now: Timestamp) -> impl Iterator<Item = &str> {
        let recent = self
            .causes
            .iter()
            .filter(move |(_, c)| seconds(c.at, now) <= self.cool_down_s);
        recent.filter_map(move |(cause, _)| cause.user_with(kind))
    }

    pub fn clear(&mut self) {
        self.causes.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(s: i64) -> Timestamp {
        Timestamp::from_second(s).unwrap()
    }

    #[test]
    fn the_hold_doubles_up_to_the_cool_down() {
        let cleared = ClearedCauses::new(60.0);
        assert_eq!(
            [0, 1, 2, 5, 6, 99].map(|n| cleared.hold_s(n)),
            [1.0, 2.0, 4.0, 32.0, 60.0, 60.0]
        );
    }

    #[test]
    fn a_cause_is_the_same_within_the_cool_down_and_once() {
        let cause = Cause::System(AlertKind::SensorLost);
        for (s, recurrences) in [(59, Some(3)), (61, None)] {
            let mut cleared = ClearedCauses::new(60.0);
            cleared.push(cause.clone(), 3, None, at(0));
            assert_eq!(cleared.take(&cause, None, at(s)), recurrences);
            assert_eq!(cleared.take(&cause, None, at(s)), None);
        }
    }

    #[test]
    fn a_beam_is_the_same_within_ten_metres() {
        for (x, recurrences) in [(9.9, Some(1)), (10.1, None)] {
            let mut cleared = ClearedCauses::new(60.0);
            cleared.push(Cause::Track(1), 1, Some([0.0, 0.0]), at(0));
            assert_eq!(cleared.take(&Cause::Track(2), Some([x, 0.0]), at(1)), recurrences);
        }
    }

    #[test]
    fn memory_is_bounded_and_what_is_old_makes_way() {
        let mut cleared = ClearedCauses::new(60.0);
        for k in 0..=MAX_CLEARED as u64 {
            cleared.push(Cause::Track(k), 0, None, at(0));
        }
        assert_eq!(cleared.causes.len(), MAX_CLEARED);
        let last = Cause::User(AlertKind::UserUnseen, "a".into());
        cleared.push(last.clone(), 0, None, at(61));
        assert_eq!(cleared.causes.into_keys().collect::<Vec<_>>(), [last]);
    }
}
