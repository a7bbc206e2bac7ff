use std::collections::{BTreeMap, BTreeSet};

use crate::assign::assign;
use crate::claims::Store;
use crate::monitor::alert::AlertKind;
use crate::monitor::alert_lifecycle::Cause;
use crate::monitor::input::claim_state::{ActiveClaim, CLAIM_LIFE_S};
use crate::monitor::monitor::Monitor;
use crate::monitor::track::kalman::mahalanobis2;
use crate::monitor::track::tracker::Track;

/// Squared Mahalanobis distance within which a beam can answer a claim.
const ANSWER_GATE: f64 = 25.0;
/// What an assignment must gain before a claim is answered by another beam than before.
const INCUMBENCY: f64 = 4.0;

impl Monitor {
    /// Which track answers which claim: near pairs by optimal assignment, then the beam that answered before.
    pub fn answer(&self, active: &[ActiveClaim], claims: &Store) -> Vec<Option<u64>> {
        // Whose claim each track answered in the frame before.
        let owners: BTreeMap<u64, &ActiveClaim> = active.iter().filter_map(|a| Some((a.owns?, a))).collect();
        let seen: Vec<&Track> = self.tracks.all.iter().filter(|t| t.hit).collect();
        let merged_into: Vec<&Track> = self.tracks.all.iter().filter(|t| t.merged_into.is_some()).collect();
        let mut association = vec![None; active.len()];
        // A frame that misses a user's beam must not let another beam nearby pass for it.
        let held: Vec<bool> = active
            .iter()
            .map(|a| {
                a.before
                    .and_then(|id| self.tracks.get(id))
                    .is_some_and(Track::is_just_missed)
            })
            .collect();
        for tracks in [&seen, &merged_into] {
            let open: Vec<usize> = (0..active.len())
                .filter(|&i| association[i].is_none() && !held[i])
                .collect();
            let matching = assign(open.len(), tracks.len(), ANSWER_GATE + INCUMBENCY, |i, j| {
                let (a, t) = (&active[open[i]], tracks[j]);
                let r = t.motion.position() - a.position;
                let d2 = mahalanobis2(r, t.motion.position_cov() + a.spread(self.config.tolerated_distance_m));
                if d2 > ANSWER_GATE {
                    return f64::INFINITY;
                }
                let incumbent = a.before == Some(t.id);
                let owner = owners.get(&t.id).copied();
                if (!incumbent && a.age_s > self.fresh_s(a)) || !self.may_answer(a, t, owner, claims) {
                    f64::INFINITY
                } else if incumbent {
                    d2
                } else {
                    d2 + INCUMBENCY
                }
            });
            for (i, j) in matching.pairs {
                association[open[i]] = Some(tracks[j].id);
            }
        }
        let mut taken: BTreeSet<u64> = association.iter().flatten().copied().collect();
        for (a, answer) in active.iter().zip(&mut association) {
            if answer.is_some() || (self.crowding.is_crowded() && !a.is_established) {
                continue;
            }
            if let Some(id) = a.before
                && seen.iter().any(|t| t.id == id)
                && taken.insert(id)
            {
                *answer = Some(id);
            }
        }
        association
    }

    /// Age up to which a claim answers for a beam that was not its user's before, s: the longer a user is silent, the
    /// wider the ground that a stranger could appear on under their name.
    fn fresh_s(&self, a: &ActiveClaim) -> f64 {
        if self.alerts.is_open(&Cause::Whole(AlertKind::ClaimsStale)) {
            return CLAIM_LIFE_S;
        }
        let period = self.period_s.unwrap_or(CLAIM_LIFE_S).max(a.period_s.unwrap_or(0.0));
        self.config.claims_stale_s.max(5.0 * period).min(CLAIM_LIFE_S)
    }
}
