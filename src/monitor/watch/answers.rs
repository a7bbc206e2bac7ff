use std::collections::{BTreeMap, BTreeSet};

use super::Monitor;
use super::chance::Crowding;
use crate::assign::assign;
use crate::claims::Store;
use crate::monitor::AlertKind;
use crate::monitor::book::Cause;
use crate::monitor::motion::mahalanobis2;
use crate::monitor::tracks::Track;
use crate::monitor::users::{Asserted, CLAIM_LIFE_S};

/// Squared Mahalanobis distance within which a beam can answer a claim.
const ANSWER_GATE: f64 = 25.0;
/// What an assignment must gain before a claim is answered by another beam than before.
const INCUMBENCY: f64 = 4.0;

impl Monitor {
    /// Which track answers which claim: near pairs by optimal assignment, then the beam that answered before.
    pub(super) fn answer(&self, asserted: &[Asserted], crowding: &Crowding, claims: &Store) -> Vec<Option<u64>> {
        let owners = self.owners(asserted);
        let seen: Vec<&Track> = self.tracks.all.iter().filter(|t| t.hit).collect();
        let merged: Vec<&Track> = self.tracks.all.iter().filter(|t| t.merged.is_some()).collect();
        let mut answers = vec![None; asserted.len()];
        // A frame that misses a user's beam must not let another beam nearby pass for it.
        let held: Vec<bool> = asserted
            .iter()
            .map(|a| {
                let before = self.users.get(&a.claim.user).and_then(|u| u.track);
                before
                    .and_then(|id| self.tracks.get(id))
                    .is_some_and(Track::is_just_missed)
            })
            .collect();
        for tracks in [&seen, &merged] {
            let open: Vec<usize> = (0..asserted.len())
                .filter(|&i| answers[i].is_none() && !held[i])
                .collect();
            let matching = assign(open.len(), tracks.len(), ANSWER_GATE + INCUMBENCY, |i, j| {
                let (a, t) = (&asserted[open[i]], tracks[j]);
                let r = t.motion.position() - a.position;
                let d2 = mahalanobis2(r, t.motion.position_cov() + a.spread(self.config.tolerated_distance_m));
                let incumbent = self.users.get(&a.claim.user).and_then(|u| u.track) == Some(t.id);
                if d2 > ANSWER_GATE || (!incumbent && a.age_s > self.fresh_s(a)) {
                    return f64::INFINITY;
                }
                let owner = owners.get(&t.id).map(|&k| &asserted[k]);
                if !self.may_answer(a, t, owner, crowding, claims) {
                    f64::INFINITY
                } else if incumbent {
                    d2
                } else {
                    d2 + INCUMBENCY
                }
            });
            for (i, j) in matching.pairs {
                answers[open[i]] = Some(tracks[j].id);
            }
        }
        let mut taken: BTreeSet<u64> = answers.iter().flatten().copied().collect();
        for (a, answer) in asserted.iter().zip(&mut answers) {
            if answer.is_some() || (crowding.is_crowded() && !self.is_established(a)) {
                continue;
            }
            let before = self.users.get(&a.claim.user).and_then(|u| u.track);
            if let Some(id) = before
                && seen.iter().any(|t| t.id == id)
                && taken.insert(id)
            {
                *answer = Some(id);
            }
        }
        answers
    }

    /// Whose claim each track answered in the frame before, by track.
    fn owners(&self, asserted: &[Asserted]) -> BTreeMap<u64, usize> {
        let of = |a: &Asserted| {
            let user = self.users.get(&a.claim.user)?;
            user.track.filter(|_| user.unanswered_since.is_none())
        };
        (0..asserted.len())
            .filter_map(|i| Some((of(&asserted[i])?, i)))
            .collect()
    }

    /// Age up to which a claim answers for a beam that was not its user's before, s: the longer a user is silent, the
    /// wider the ground that a stranger could appear on under their name.
    fn fresh_s(&self, a: &Asserted) -> f64 {
        if self.book.is_open(&Cause::Whole(AlertKind::ClaimsStale)) {
            return CLAIM_LIFE_S;
        }
        let period = self.period_s.unwrap_or(CLAIM_LIFE_S).max(a.period_s.unwrap_or(0.0));
        self.config.claims_stale_s.max(5.0 * period).min(CLAIM_LIFE_S)
    }
}
