use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};

use jiff::Timestamp;
use serde::Serialize;

use super::{Claim, ClaimState, Config};

/// Claims kept per user: enough to place a user some seconds back and to know their pace.
const HISTORY: usize = 16;
/// Claims waiting for their own time to come (a replayed log is read ahead of its frames).
const MOST_AHEAD: usize = 500_000;
/// A user silent or ended for this long may be forgotten when room is needed.
const FORGET_AFTER_S: f64 = 600.0;

/// The network's claims: the newest of every user with a short history. Bounded in users, history and claims ahead of
/// their time. Time comes with each call; nothing here reads a clock.
#[derive(Debug)]
pub struct Store {
    users: BTreeMap<String, History>,
    ahead: BinaryHeap<Reverse<Ahead>>,
    sequence: u64,
    max_users: usize,
    counts: Counts,
    newest: Option<Arrival>,
}

/// What became of a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The user's newest claim now.
    Accepted,
    /// Kept until its own time comes.
    Ahead,
    /// Older than the user's newest claim: kept as history only.
    Late,
    /// Older than the whole history.
    TooLate,
    /// The same claim again.
    Duplicate,
    /// The user already claimed another position for the same time; the first stands.
    Conflicting,
    /// No room for another user, or for another claim ahead of its time.
    Full,
}

/// How many claims had each outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    pub accepted: u64,
    pub ahead: u64,
    pub late: u64,
    pub too_late: u64,
    pub duplicate: u64,
    pub conflicting: u64,
    pub full: u64,
}

/// When the newest accepted claim of all was made and when it came.
#[derive(Clone, Copy, Debug)]
struct Arrival {
    made: Timestamp,
    came: Timestamp,
}

#[derive(Debug)]
struct History {
    /// By rising time; never empty.
    claims: VecDeque<Claim>,
    came: Timestamp,
}

#[derive(Debug, PartialEq)]
struct Ahead {
    time: Timestamp,
    sequence: u64,
    claim: Claim,
}

impl Eq for Ahead {}

impl PartialOrd for Ahead {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Ahead {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.time, self.sequence).cmp(&(other.time, other.sequence))
    }
}

/// One user's newest claim, and what is needed to weigh it.
#[derive(Clone, Copy, Debug)]
pub struct Standing<'a> {
    pub claim: &'a Claim,
    /// When the newest claim came in (the claim itself carries when it was made).
    pub came: Timestamp,
    /// Claimed displacement per second over the history, m/s; 0 for a first claim.
    pub pace_m_s: f64,
    /// Seconds between the last two claims.
    pub period_s: Option<f64>,
}

/// Seconds from `from` to `to`.
pub(crate) fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    (to.as_nanosecond() - from.as_nanosecond()) as f64 * 1e-9
}

impl Store {
    pub fn new(config: &Config) -> Self {
        Self {
            users: BTreeMap::new(),
            ahead: BinaryHeap::new(),
            sequence: 0,
            max_users: config.max_users,
            counts: Counts::default(),
            newest: None,
        }
    }

    /// Takes a claim that came in at `now` (the frames' clock). One made for a later time waits for [`Store::advance`].
    pub fn insert(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let outcome = if claim.time > now {
            self.hold_back(claim)
        } else {
            self.place(claim, now)
        };
        self.count(outcome);
        outcome
    }

    /// Lets every claim whose time has come by `now` stand.
    pub fn advance(&mut self, now: Timestamp) {
        while self.ahead.peek().is_some_and(|Reverse(a)| a.time <= now) {
            if let Some(Reverse(due)) = self.ahead.pop() {
                let outcome = self.place(due.claim, now);
                self.count(outcome);
            }
        }
    }

    /// The clock was set back to `now`: what was claimed for later times no longer stands.
    pub fn set_back(&mut self, now: Timestamp) {
        for history in self.users.values_mut() {
            history.claims.retain(|claim| claim.time <= now);
            history.came = history.came.min(now);
        }
        self.users.retain(|_, history| !history.claims.is_empty());
        self.newest = None;
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    pub fn len(&self) -> usize {
        self.users.len()
    }

    pub fn is_empty(&self) -> bool {
        self.users.is_empty()
    }

    /// Every user's newest claim, by name.
    pub fn standing(&self) -> impl Iterator<Item = Standing<'_>> {
        self.users.values().map(History::standing)
    }

    pub fn user(&self, user: &str) -> Option<Standing<'_>> {
        self.users.get(user).map(History::standing)
    }

    /// Where `user`'s claims put them at `time`: on the line between the two claims around it, else the nearest one.
    pub fn position_at(&self, user: &str, time: Timestamp) -> Option<[f64; 2]> {
        let claims = &self.users.get(user)?.claims;
        let after = claims.partition_point(|c| c.time <= time);
        match (after.checked_sub(1).map(|i| &claims[i]), claims.get(after)) {
            (Some(a), Some(b)) => {
                let share = seconds(a.time, time) / seconds(a.time, b.time);
                Some([a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)])
            }
            (Some(c), None) | (None, Some(c)) => Some([c.x_m, c.y_m]),
            (None, None) => None,
        }
    }

    /// Time since the newest claim came and since it was made, in this order, s; `None` before the first.
    pub fn quiet_s(&self, now: Timestamp) -> Option<(f64, f64)> {
        self.newest.map(|n| (seconds(n.came, now), seconds(n.made, now)))
    }

    /// The time that the newest claim of all was made for.
    pub fn newest(&self) -> Option<Timestamp> {
        self.newest.map(|n| n.made)
    }

    fn count(&mut self, outcome: Outcome) {
        let c = &mut self.counts;
        *match outcome {
            Outcome::Accepted => &mut c.accepted,
            Outcome::Ahead => &mut c.ahead,
            Outcome::Late => &mut c.late,
            Outcome::TooLate => &mut c.too_late,
            Outcome::Duplicate => &mut c.duplicate,
            Outcome::Conflicting => &mut c.conflicting,
            Outcome::Full => &mut c.full,
        } += 1;
    }

    fn hold_back(&mut self, claim: Claim) -> Outcome {
        if self.ahead.len() >= MOST_AHEAD {
            return Outcome::Full;
        }
        self.sequence += 1;
        self.ahead.push(Reverse(Ahead {
            time: claim.time,
            sequence: self.sequence,
            claim,
        }));
        Outcome::Ahead
    }

    fn place(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let made = claim.time;
        let outcome = match self.users.get_mut(&claim.user) {
            Some(history) => history.place(claim, now),
            None => {
                if self.users.len() >= self.max_users && !self.forget_one(now) {
                    return Outcome::Full;
                }
                let claims = VecDeque::from([claim.clone()]);
                self.users.insert(claim.user, History { claims, came: now });
                Outcome::Accepted
            }
        };
        if outcome == Outcome::Accepted && self.newest.is_none_or(|n| made > n.made) {
            self.newest = Some(Arrival { made, came: now });
        }
        outcome
    }

    /// Only users long silent make room, so that a flood of invented ones cannot push out those that are there.
    fn forget_one(&mut self, now: Timestamp) -> bool {
        let oldest = self.users.iter().min_by_key(|(_, h)| h.came);
        let name = oldest
            .filter(|(_, h)| seconds(h.came, now) > FORGET_AFTER_S)
            .map(|(name, _)| name.clone());
        name.is_some_and(|name| self.users.remove(&name).is_some())
    }
}

impl History {
    fn standing(&self) -> Standing<'_> {
        let claim = self.claims.back().expect("a history holds at least one claim");
        let active = |c: &&Claim| c.state == ClaimState::Active;
        let mut recent = self.claims.iter().rev().filter(active).take(6);
        let (last, first) = (recent.next(), recent.last());
        let pace_m_s = match (first, last) {
            (Some(a), Some(b)) => (b.x_m - a.x_m).hypot(b.y_m - a.y_m) / seconds(a.time, b.time).max(0.05),
            _ => 0.0,
        };
        let before = self.claims.len().checked_sub(2).map(|i| &self.claims[i]);
        Standing {
            claim,
            came: self.came,
            pace_m_s,
            period_s: before.map(|b| seconds(b.time, claim.time)),
        }
    }

    fn place(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let at = self.claims.partition_point(|c| c.time < claim.time);
        if let Some(same) = self.claims.get(at).filter(|c| c.time == claim.time) {
            return if *same == claim {
                Outcome::Duplicate
            } else {
                Outcome::Conflicting
            };
        }
        if at == self.claims.len() {
            self.came = now;
            self.claims.push_back(claim);
            if self.claims.len() > HISTORY {
                self.claims.pop_front();
            }
            Outcome::Accepted
        } else if self.claims.len() < HISTORY {
            self.claims.insert(at, claim);
            Outcome::Late
        } else {
            Outcome::TooLate
        }
    }
}
