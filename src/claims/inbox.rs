//! Claims between the thread that reads the log and the one that handles frames: bounded, and taken a little at a time, so that no frame waits for claims.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use super::history::HISTORY;
use super::pressure::Squeeze;
use super::{Claim, Roster};

/// Claims of known names taken with one frame: 10,000 users at 1 Hz and 10 frames/s.
const KNOWN_A_FRAME: usize = 1024;
/// Claims of other names taken with one frame. Each costs about a microsecond: a frame is a few tenths of a millisecond later, and 100 newcomers a frame are
/// more than any network has.
const NEW_A_FRAME: usize = 256;
/// Claims of known names that wait at most, and of others: eight frames' worth.
const MOST_KNOWN: usize = 16 * KNOWN_A_FRAME;
pub const MOST_NEW: usize = 8 * NEW_A_FRAME;
/// Claims sorted under one lock.
const CHUNK: usize = 256;

/// A queue of claims with two lanes: of names that the store protects, and of all others. A flood of invented names sheds its own, oldest first.
#[derive(Clone, Debug)]
pub struct Inbox {
    waiting: Arc<Mutex<Waiting>>,
    roster: Roster,
}

#[derive(Debug, Default)]
struct Waiting {
    /// By name, as many as a history holds; and whose turn it is.
    known: HashMap<String, VecDeque<Claim>>,
    turn: VecDeque<String>,
    known_count: usize,
    new: VecDeque<Claim>,
    shed: Squeeze,
}

/// What was taken with a frame.
#[derive(Debug, Default)]
pub struct Batch {
    pub claims: Vec<Claim>,
    /// What was shed since the last one.
    pub shed: Squeeze,
}

impl Waiting {
    fn push(&mut self, claim: Claim, is_known: bool) -> Option<Claim> {
        if !is_known {
            self.new.push_back(claim);
            let shed = (self.new.len() > MOST_NEW).then(|| self.new.pop_front())?;
            self.shed.shed_new += 1;
            return shed;
        }
        if let Some(queue) = self.known.get_mut(&claim.user) {
            queue.push_back(claim);
            if queue.len() > HISTORY {
                self.shed.shed_known += 1;
                return queue.pop_front();
            }
        } else {
            self.turn.push_back(claim.user.clone());
            self.known.insert(claim.user.clone(), VecDeque::from([claim]));
        }
        self.known_count += 1;
        let shed = (self.known_count > MOST_KNOWN).then(|| self.pop_known())?;
        self.shed.shed_known += 1;
        shed
    }

    /// One claim of the name whose turn it is.
    fn pop_known(&mut self) -> Option<Claim> {
        let name = self.turn.pop_front()?;
        let queue = self.known.get_mut(&name)?;
        let claim = queue.pop_front();
        self.known_count -= usize::from(claim.is_some());
        match queue.is_empty() {
            true => drop(self.known.remove(&name)),
            false => self.turn.push_back(name),
        }
        claim
    }
}

impl Inbox {
    pub fn new(roster: Roster) -> Self {
        Self {
            waiting: Arc::default(),
            roster,
        }
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves claims. Where there is no room the oldest go, and are counted.
    pub fn offer(&self, claims: Vec<Claim>) {
        let mut claims = claims.into_iter();
        loop {
            let chunk: Vec<Claim> = claims.by_ref().take(CHUNK).collect();
            if chunk.is_empty() {
                return;
            }
            let known = self.roster.knows(chunk.iter().map(|claim| claim.user.as_str()));
            let mut waiting = self.lock();
            let shed = chunk
                .into_iter()
                .zip(known)
                .map(|(claim, known)| waiting.push(claim, known));
            let shed: Vec<_> = shed.collect();
            drop(waiting);
            drop(shed);
        }
    }

    /// Bytes of the log were passed over.
    pub fn skipped(&self, bytes: u64) {
        self.lock().shed.skipped_bytes += bytes;
    }

    /// What a frame has time for, those of known names first. Nothing while claims are being left: the next frame takes them.
    pub fn take(&self) -> Batch {
        let mut waiting = match self.waiting.try_lock() {
            Ok(waiting) => waiting,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Batch::default(),
        };
        let mut claims: Vec<Claim> = std::iter::from_fn(|| waiting.pop_known()).take(KNOWN_A_FRAME).collect();
        let new = waiting.new.len().min(NEW_A_FRAME);
        claims.extend(waiting.new.drain(..new));
        Batch {
            claims,
            shed: std::mem::take(&mut waiting.shed),
        }
    }
}

#[cfg(test)]
mod tests {
    use jiff::{SignedDuration, Timestamp};

    use super::*;
    use crate::claims::{ClaimState, Config, Store};

    fn claim(user: &str, s: i64) -> Claim {
        Claim {
            time: Timestamp::UNIX_EPOCH + SignedDuration::from_secs(s),
            user: user.into(),
            x_m: 0.0,
            y_m: 0.0,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        }
    }

    #[test]
    fn a_flood_sheds_its_own_oldest_and_known_names_come_first() {
        let mut store = Store::new(&Config::default());
        let start = Timestamp::UNIX_EPOCH;
        for user in ["a", "b"] {
            store.insert(claim(user, 0), start);
            store.answered(user, start);
        }
        store.advance(start);
        let inbox = Inbox::new(store.roster());
        inbox.offer((0..5000).map(|k| claim(&format!("!{k}"), 1)).collect());
        inbox.offer((1..=40).flat_map(|s| [claim("a", s), claim("b", s)]).collect());
        let batch = inbox.take();
        assert_eq!(batch.shed.shed_new, 5000 - MOST_NEW as u64);
        assert_eq!(batch.shed.shed_known, 2 * (40 - HISTORY as u64));
        let (known, new) = batch.claims.split_at(2 * HISTORY);
        assert!(known.iter().all(|c| ["a", "b"].contains(&c.user.as_str())));
        assert_eq!(
            known.last().map(|c| c.time),
            Some(claim("b", 40).time),
            "the newest are kept"
        );
        assert_eq!(new.len(), NEW_A_FRAME);
        assert_eq!(new[0].user, format!("!{}", 5000 - MOST_NEW));
        assert_eq!(inbox.take().claims.len(), NEW_A_FRAME);
        assert_eq!(inbox.lock().known_count, 0);
    }
}
