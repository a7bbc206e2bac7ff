//! One user's claims: the newest and a short history, enough to place the user some seconds back and to know their pace.

use std::collections::VecDeque;

use jiff::Timestamp;

use super::outcome::Outcome;
use super::{Claim, ClaimState};
use crate::time::seconds;

/// Claims kept per user, the newest included. Sixteen reach back sixteen seconds at 1 Hz, further than a beam's trail (6 s).
pub(super) const HISTORY: usize = 16;
/// Newest active claims that the pace is taken over. More remember for longer that a user who stands drives, fewer forget sooner who has driven.
/// Not measured.
const PACE_CLAIMS: usize = 6;

/// A user's claims by rising time. The name is stored with the newest only: a name may be a kilobyte long.
#[derive(Debug)]
pub(super) struct History {
    newest: Claim,
    older: VecDeque<Made>,
    /// When the newest claim came in.
    pub came: Timestamp,
    /// As in [`Standing`]: asked for in every frame, and new with a claim only.
    pace_m_s: f64,
}

/// A claim without its name.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Made {
    time: Timestamp,
    x_m: f64,
    y_m: f64,
    z_m: Option<f64>,
    sigma_m: Option<f64>,
    cov_m2: Option<[[f64; 2]; 2]>,
    power_w: Option<f64>,
    state: ClaimState,
}

/// One user's newest claim, and what is needed to weigh it.
#[derive(Clone, Copy, Debug)]
pub struct Standing<'a> {
    pub claim: &'a Claim,
    /// When the newest claim came in (the claim itself carries when it was made).
    pub came: Timestamp,
    /// The fastest way from one of the newest claims to the next, less what their own errors make, m/s; 0 for a first claim.
    pub pace_m_s: f64,
    /// Seconds between the last two claims.
    pub period_s: Option<f64>,
}

impl Made {
    fn of(claim: &Claim) -> Self {
        Self {
            time: claim.time,
            x_m: claim.x_m,
            y_m: claim.y_m,
            z_m: claim.z_m,
            sigma_m: claim.sigma_m,
            cov_m2: claim.cov_m2,
            power_w: claim.power_w,
            state: claim.state,
        }
    }

    fn into_claim(self, user: String) -> Claim {
        Claim {
            time: self.time,
            user,
            x_m: self.x_m,
            y_m: self.y_m,
            z_m: self.z_m,
            sigma_m: self.sigma_m,
            cov_m2: self.cov_m2,
            power_w: self.power_w,
            state: self.state,
        }
    }
}

impl History {
    pub fn new(claim: Claim, came: Timestamp) -> Self {
        Self {
            newest: claim,
            older: VecDeque::new(),
            came,
            pace_m_s: 0.0,
        }
    }

    fn newest_first(&self) -> impl Iterator<Item = Made> {
        std::iter::once(Made::of(&self.newest)).chain(self.older.iter().rev().copied())
    }

    pub fn standing(&self) -> Standing<'_> {
        Standing {
            claim: &self.newest,
            came: self.came,
            pace_m_s: self.pace_m_s,
            period_s: self.older.back().map(|b| seconds(b.time, self.newest.time)),
        }
    }

    fn pace_m_s(&self) -> f64 {
        let is_active = |made: &Made| made.state == ClaimState::Active;
        let recent = || self.newest_first().filter(is_active).take(PACE_CLAIMS);
        let legs = recent().zip(recent().skip(1)).map(|(b, a)| {
            let by_error_m = a.sigma_m.unwrap_or(0.0) + b.sigma_m.unwrap_or(0.0);
            let way_m = (b.x_m - a.x_m).hypot(b.y_m - a.y_m) - by_error_m;
            way_m / seconds(a.time, b.time).max(0.05)
        });
        legs.fold(0.0, f64::max)
    }

    /// On the line between the two claims around `time`, else the nearest claim's place.
    pub fn position_at(&self, time: Timestamp) -> [f64; 2] {
        let newest = Made::of(&self.newest);
        let after = self.older.partition_point(|made| made.time <= time);
        let before = after.checked_sub(1).map(|i| self.older[i]);
        match (before, self.older.get(after).copied()) {
            _ if newest.time <= time => [newest.x_m, newest.y_m],
            (Some(a), after) => {
                let b = after.unwrap_or(newest);
                let share = seconds(a.time, time) / seconds(a.time, b.time);
                [a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)]
            }
            (None, first) => {
                let first = first.unwrap_or(newest);
                [first.x_m, first.y_m]
            }
        }
    }

    /// Takes a claim of this user that came in at `now`.
    pub fn place(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let outcome = self.take(claim, now);
        if matches!(outcome, Outcome::Accepted | Outcome::Late) {
            self.pace_m_s = self.pace_m_s();
        }
        outcome
    }

    fn take(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        if claim.time > self.newest.time {
            let before = std::mem::replace(&mut self.newest, claim);
            self.came = now;
            self.older.push_back(Made::of(&before));
            if self.older.len() >= HISTORY {
                self.older.pop_front();
            }
            return Outcome::Accepted;
        }
        let made = Made::of(&claim);
        let at = self.older.partition_point(|m| m.time < made.time);
        let same = match made.time == self.newest.time {
            true => Some(Made::of(&self.newest)),
            false => self.older.get(at).filter(|m| m.time == made.time).copied(),
        };
        match same {
            Some(same) if same == made => Outcome::Duplicate,
            Some(_) => Outcome::Conflicting,
            None if self.older.len() + 1 < HISTORY => {
                self.older.insert(at, made);
                Outcome::Late
            }
            None => Outcome::TooLate,
        }
    }

    /// The clock was set back to `now`: later claims no longer stand. `None` where none is left.
    pub fn set_back(mut self, now: Timestamp) -> Option<Self> {
        self.came = self.came.min(now);
        if self.newest.time <= now {
            return Some(self);
        }
        self.older.retain(|made| made.time <= now);
        let newest = self.older.pop_back()?;
        self.newest = newest.into_claim(self.newest.user);
        self.pace_m_s = self.pace_m_s();
        Some(self)
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;

    fn at(s: i64) -> Timestamp {
        Timestamp::UNIX_EPOCH + SignedDuration::from_secs(s)
    }

    fn claim(s: i64, x_m: f64) -> Claim {
        Claim {
            time: at(s),
            user: "u".into(),
            x_m,
            y_m: 0.0,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        }
    }

    #[test]
    fn keeps_sixteen_claims_and_places_between_them() {
        let mut history = History::new(claim(0, 0.0), at(0));
        for s in 1..=20 {
            assert_eq!(
                history.place(claim(2 * s, 4.0 * s as f64), at(2 * s)),
                Outcome::Accepted
            );
        }
        assert_eq!(history.older.len() + 1, HISTORY);
        assert_eq!(history.position_at(at(39)), [78.0, 0.0]);
        assert_eq!(history.position_at(at(99)), [80.0, 0.0]);
        assert_eq!(history.position_at(at(1)), [20.0, 0.0], "the oldest kept");
        assert_eq!(history.place(claim(39, 78.0), at(40)), Outcome::TooLate);
        assert_eq!(history.place(claim(36, 72.0), at(40)), Outcome::Duplicate);
        assert_eq!(history.place(claim(40, 1.0), at(40)), Outcome::Conflicting);
        let standing = history.standing();
        assert_eq!((standing.pace_m_s, standing.period_s), (2.0, Some(2.0)));
    }

    #[test]
    fn a_car_that_has_stopped_or_come_back_has_the_pace_of_its_fastest_leg() {
        let mut history = History::new(claim(0, 0.0), at(0));
        for (s, x_m) in [(3, 30.0), (6, 30.0), (9, 0.0)] {
            history.place(claim(s, x_m), at(s));
        }
        assert_eq!(history.standing().pace_m_s, 10.0);
        let unsure = |s: i64, x_m: f64| Claim {
            sigma_m: Some(2.0),
            ..claim(s, x_m)
        };
        let mut history = History::new(unsure(0, 0.0), at(0));
        for s in 1..6 {
            history.place(unsure(s, if s % 2 == 0 { 0.0 } else { 4.0 }), at(s));
        }
        assert_eq!(history.standing().pace_m_s, 0.0);
    }

    #[test]
    fn a_clock_set_back_takes_later_claims_away() {
        let mut history = History::new(claim(0, 0.0), at(0));
        history.place(claim(10, 10.0), at(10));
        let history = history.set_back(at(5)).unwrap();
        assert_eq!((history.newest.x_m, history.came), (0.0, at(5)));
        assert_eq!(history.newest.user, "u");
        assert!(History::new(claim(9, 0.0), at(9)).set_back(at(5)).is_none());
    }
}
