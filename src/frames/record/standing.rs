//! What is in force at one time, which a new recording begins with: the users' claims and the newest poses.

use std::collections::{BTreeMap, VecDeque};

use crate::claim::{Claim, ClaimState};

use crate::frames::Arrivals;
use crate::pose::Pose;
use crate::time::seconds;

/// Most users kept; beyond it those who have ended are removed first.
const MOST_USERS: usize = 10_000;
/// Poses kept, s before the newest: longer than poses are late or rates are taken over.
const POSES_S: f64 = 1.0;
/// Most poses kept.
const MOST_POSES: usize = 256;

/// Each user's last two claims, between which a position is interpolated, and the newest poses.
#[derive(Clone, Debug, Default)]
pub(super) struct Standing {
    users: BTreeMap<String, (Option<Claim>, Claim)>,
    poses: VecDeque<Pose>,
}

impl Standing {
    /// Adds what came with a frame, in the order of arrival.
    pub fn take(&mut self, arrivals: &Arrivals) {
        for claim in &arrivals.claims {
            let before = self.users.remove(&claim.user).map(|(_, last)| last);
            self.users.insert(claim.user.clone(), (before, claim.clone()));
        }
        if self.users.len() > MOST_USERS {
            self.users.retain(|_, (_, last)| last.state == ClaimState::Active);
        }
        while self.users.len() > MOST_USERS {
            self.users.pop_first();
        }
        self.poses.extend(arrivals.poses.iter().cloned());
        if let Some(newest) = self.poses.back().map(|pose| pose.time) {
            let is_old = |pose: &Pose| seconds(pose.time, newest) > POSES_S;
            while self.poses.len() > MOST_POSES || self.poses.front().is_some_and(is_old) {
                self.poses.pop_front();
            }
        }
    }

    /// Claims oldest first, poses in the order of arrival.
    pub fn arrivals(&self) -> Arrivals {
        let both = self
            .users
            .values()
            .flat_map(|(before, last)| before.iter().chain([last]));
        let mut claims: Vec<Claim> = both.cloned().collect();
        claims.sort_by_key(|claim| claim.time);
        Arrivals {
            claims,
            poses: self.poses.iter().cloned().collect(),
        }
    }
}
