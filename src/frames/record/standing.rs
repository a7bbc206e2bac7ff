//! The claims in force at one time, which a new recording begins with.

use std::collections::BTreeMap;

use crate::claim::{Claim, ClaimState};

/// Most users kept; beyond it those who have ended are removed first.
const MOST_USERS: usize = 10_000;

/// Each user's last two claims, between which a position is interpolated.
#[derive(Clone, Debug, Default)]
pub(super) struct Standing(BTreeMap<String, (Option<Claim>, Claim)>);

impl Standing {
    /// Adds claims in the order of their arrival.
    pub fn take(&mut self, claims: &[Claim]) {
        for claim in claims {
            let before = self.0.remove(&claim.user).map(|(_, last)| last);
            self.0.insert(claim.user.clone(), (before, claim.clone()));
        }
        if self.0.len() > MOST_USERS {
            self.0.retain(|_, (_, last)| last.state == ClaimState::Active);
        }
        while self.0.len() > MOST_USERS {
            self.0.pop_first();
        }
    }

    /// Oldest first.
    pub fn claims(&self) -> Vec<Claim> {
        let both = self.0.values().flat_map(|(before, last)| before.iter().chain([last]));
        let mut claims: Vec<Claim> = both.cloned().collect();
        claims.sort_by_key(|claim| claim.time);
        claims
    }
}
