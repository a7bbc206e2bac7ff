//! When a user in two places becomes an alert, and when it ends.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::stations::Sighting;

use crate::time::seconds;

/// A conflict lasts so long before it is raised, s: at a handover, one station's track outlives the beam by some frames.
const RAISED_AFTER_S: f64 = 1.5;
/// An interruption of this length starts the count again, s: a few messages.
const INTERRUPTED_S: f64 = 0.5;
/// And is gone so long before it is cleared, s.
const CLEARED_AFTER_S: f64 = 5.0;

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Conflict {
    since: Timestamp,
    last: Timestamp,
}

/// Users who were lately in two places.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Conflicts {
    of_user: BTreeMap<String, Conflict>,
}

impl Conflicts {
    /// Takes the conflicts of now; gives those that stand for long enough and the users whose conflict is over.
    pub fn step(
        &mut self,
        found: BTreeMap<String, [Sighting; 2]>,
        now: Timestamp,
    ) -> (Vec<(String, [Sighting; 2])>, Vec<String>) {
        let mut standing = Vec::new();
        for (user, sightings) in found {
            let conflict = self
                .of_user
                .entry(user.clone())
                .or_insert(Conflict { since: now, last: now });
            if seconds(conflict.last, now) > INTERRUPTED_S {
                conflict.since = now;
            }
            conflict.last = now;
            if seconds(conflict.since, now) >= RAISED_AFTER_S {
                standing.push((user, sightings));
            }
        }
        let is_over = |conflict: &Conflict| seconds(conflict.last, now) > CLEARED_AFTER_S;
        let over: Vec<String> = self
            .of_user
            .iter()
            .filter(|(_, c)| is_over(c))
            .map(|(user, _)| user.clone())
            .collect();
        for user in &over {
            self.of_user.remove(user);
        }
        (standing, over)
    }

    /// Goes on watching users whose conflict an earlier run raised.
    pub fn restore(&mut self, users: impl Iterator<Item = String>, now: Timestamp) {
        self.of_user
            .extend(users.map(|user| (user, Conflict { since: now, last: now })));
    }
}
