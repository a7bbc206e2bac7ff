//! Counts of claims that found no room, over the newest seconds: what the alert of a flood says.

use std::collections::VecDeque;

use jiff::Timestamp;
use serde::Serialize;

/// Whole seconds that the counts are taken over. Longer than a claim period, so that a flood in bursts is one flood.
pub const WINDOW_S: i64 = 10;
/// As long as a claim may answer for a beam that was not its user's before, whole seconds (`CLAIM_LIFE_S` of the monitor).
const CLAIM_LIFE_S: i64 = 60;

/// Claims that found no room, by what became of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Squeeze {
    /// New names refused because the store is full of names heard lately.
    pub refused: u64,
    /// Names forgotten before they were long silent, to make room for others.
    pub forgotten_early: u64,
    /// Claims of names not yet known, shed unread because more came than a frame has time for.
    pub shed_new: u64,
    /// Claims of known names shed likewise: more of one name than its history holds, or of all names than a frame has time for.
    pub shed_known: u64,
    /// Bytes of the log that were passed over because it grew faster than it is read.
    pub skipped_bytes: u64,
}

impl Squeeze {
    pub fn total(&self) -> u64 {
        self.refused + self.forgotten_early + self.shed_new + self.shed_known + self.skipped_bytes
    }

    fn add(&mut self, other: Self) {
        self.refused += other.refused;
        self.forgotten_early += other.forgotten_early;
        self.shed_new += other.shed_new;
        self.shed_known += other.shed_known;
        self.skipped_bytes += other.skipped_bytes;
    }
}

/// [`Squeeze`] by whole seconds.
#[derive(Debug, Default)]
pub(super) struct Pressure {
    by_second: VecDeque<(i64, Squeeze)>,
}

impl Pressure {
    pub fn note(&mut self, squeeze: Squeeze, now: Timestamp) {
        if squeeze.total() == 0 {
            return;
        }
        let second = now.as_second();
        match self.by_second.back_mut() {
            // A clock that goes back a little counts into the newest second.
            Some((newest, sum)) if *newest >= second => sum.add(squeeze),
            _ => self.by_second.push_back((second, squeeze)),
        }
        while self.by_second.len() > WINDOW_S as usize {
            self.by_second.pop_front();
        }
    }

    pub fn forget(&mut self) {
        self.by_second.clear();
    }

    /// Sums over the window that ends now.
    pub fn lately(&self, now: Timestamp) -> Squeeze {
        let since = now.as_second() - WINDOW_S;
        let mut sum = Squeeze::default();
        let recent = self.by_second.iter().filter(|(second, _)| *second > since);
        recent.for_each(|(_, squeeze)| sum.add(*squeeze));
        sum
    }
}

/// Names that were claimed and are not kept, over as long as a claim may answer for a beam.
#[derive(Debug, Default)]
pub(super) struct Dropped {
    by_second: VecDeque<(i64, u64)>,
}

impl Dropped {
    pub fn note(&mut self, names: u64, now: Timestamp) {
        let second = now.as_second();
        match self.by_second.back_mut() {
            Some((newest, sum)) if *newest >= second => *sum += names,
            _ => self.by_second.push_back((second, names)),
        }
        while self.by_second.len() > CLAIM_LIFE_S as usize {
            self.by_second.pop_front();
        }
    }

    pub fn forget(&mut self) {
        self.by_second.clear();
    }

    pub fn lately(&self, now: Timestamp) -> u64 {
        let since = now.as_second() - CLAIM_LIFE_S;
        let recent = self.by_second.iter().filter(|(second, _)| *second > since);
        recent.map(|(_, names)| names).sum()
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;

    #[test]
    fn counts_leave_the_window_whole() {
        let at = |s: f64| Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(1000.0 + s);
        let one = Squeeze {
            refused: 1,
            ..Squeeze::default()
        };
        let mut pressure = Pressure::default();
        for k in 0..200 {
            pressure.note(one, at(0.1 * f64::from(k)));
        }
        assert_eq!(pressure.lately(at(19.95)).refused, 100);
        assert_eq!(pressure.lately(at(24.5)).refused, 50);
        assert_eq!(pressure.lately(at(30.0)), Squeeze::default());
        assert!(pressure.by_second.len() <= WINDOW_S as usize);
    }
}
