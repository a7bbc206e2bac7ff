//! Claims made for a time that has yet to come (a log read ahead of its frames, or a log whose clock is ahead of ours).

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::Claim;

/// Claims that wait where a log is read ahead of its frames. Fewer lose claims of a long recording that is read at once, more take memory.
/// Not tuned.
pub(super) const MOST_IN_A_REPLAY: usize = 500_000;
/// Claims that wait in a live run, those of known names and all others apart: an honest log's clock is ahead by a second or two, and what falls
/// due at one instant is placed within one frame.
pub(super) const MOST_LIVE: usize = 1024;

/// Claims by due time. Where there is no more room the farthest one goes, so that times in a thousand years keep out no claim of the next second.
#[derive(Debug)]
pub(super) struct Ahead {
    waiting: BTreeMap<(Timestamp, u64), Claim>,
    sequence: u64,
    most: usize,
}

impl Ahead {
    pub fn new(most: usize) -> Self {
        Self {
            waiting: BTreeMap::new(),
            sequence: 0,
            most,
        }
    }

    pub fn set_most(&mut self, most: usize) {
        self.most = most;
    }

    /// Keeps a claim; gives the one that had to go, which may be the same.
    pub fn keep(&mut self, claim: Claim) -> Option<Claim> {
        self.sequence += 1;
        self.waiting.insert((claim.time, self.sequence), claim);
        match self.waiting.len() > self.most {
            true => self.waiting.pop_last().map(|(_, claim)| claim),
            false => None,
        }
    }

    /// Due time and order of arrival of the next claim.
    pub fn next_due(&self) -> Option<(Timestamp, u64)> {
        self.waiting.keys().next().copied()
    }

    /// The next claim.
    pub fn pop(&mut self) -> Option<Claim> {
        self.waiting.pop_first().map(|(_, claim)| claim)
    }
}
