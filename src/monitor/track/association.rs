//! Which track is associated with which user's claim, in one frame and from frame to frame.

use std::collections::{BTreeMap, BTreeSet};

use super::beam_track::{GATE, Track};
use super::eligibility::Eligibility;
use super::identity::Identity;
use super::tracker::Tracker;
use crate::assign::assign;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::stats::gaussian::mahalanobis2;

/// What an assignment must gain in squared Mahalanobis distance before a claim changes its beam. Larger keeps a wrong pair for
/// longer, smaller swaps users who pass each other. Not measured.
const INCUMBENCY: f64 = 4.0;

/// The track of each active claim in one frame.
#[derive(Clone, Debug, Default)]
pub struct Association {
    track_of: Vec<Option<u64>>,
    associated: BTreeSet<u64>,
}

impl Association {
    /// Of `claims` claims that no track is associated with.
    pub fn none(claims: usize) -> Self {
        Self {
            track_of: vec![None; claims],
            associated: BTreeSet::new(),
        }
    }

    /// Track of claim `i`.
    pub fn track_id(&self, i: usize) -> Option<u64> {
        self.track_of[i]
    }

    /// Whether a claim or a known light is associated with this track.
    pub fn contains(&self, track: u64) -> bool {
        self.associated.contains(&track)
    }

    /// A known light is associated with this track.
    pub fn assign_light(&mut self, track: u64) {
        self.associated.insert(track);
    }

    pub fn assign(&mut self, i: usize, track: u64) {
        self.track_of[i] = Some(track);
        self.associated.insert(track);
    }
}

/// Near pairs by optimal assignment, then the beam that a claim was associated with before, however far it drifted.
///
/// This is the one place where claims meet tracks, at a cost of claims × tracks; `claims::Store::choose` bounds the claims.
pub fn associate(claims: &[ActiveClaim], tracker: &Tracker, eligibility: &Eligibility) -> Association {
    // Whose claim each track was associated with in the frame before.
    let owners: BTreeMap<u64, &ActiveClaim> = claims.iter().filter_map(|a| Some((a.before.current()?, a))).collect();
    let hit: Vec<&Track> = tracker.tracks.iter().filter(|t| t.hit).collect();
    let merged: Vec<&Track> = tracker.tracks.iter().filter(|t| t.merged_into.is_some()).collect();
    let identity = Identity { tracker, eligibility };
    let held: Vec<bool> = claims.iter().map(|claim| identity.is_held(claim)).collect();
    let mut association = Association::none(claims.len());
    for tracks in [&hit, &merged] {
        let open: Vec<usize> = (0..claims.len())
            .filter(|&i| association.track_of[i].is_none() && !held[i])
            .collect();
        let matching = assign(open.len(), tracks.len(), GATE + INCUMBENCY, |i, j| {
            let (claim, track) = (&claims[open[i]], tracks[j]);
            // Where the beam was when the claim was made; of a newer one, how far its user may have gone since.
            let (beam, gone_m) = match track.at(claim.made) {
                Some(then) => (then, 0.0),
                None => (track.filter.position(), claim.slack_m),
            };
            let cov = claim.association_cov(eligibility.config.tolerated_distance_m, gone_m);
            let d2 = mahalanobis2(beam - claim.position, track.filter.position_cov() + cov);
            let owner = owners.get(&track.id).copied();
            if d2 > GATE || !eligibility.allows(claim, track, owner) || identity.refuses(claim, track) {
                f64::INFINITY
            } else if claim.before.track == Some(track.id) {
                d2
            } else {
                d2 + INCUMBENCY
            }
        });
        for (i, j) in matching.pairs {
            association.assign(open[i], tracks[j].id);
        }
    }
    for (i, claim) in claims.iter().enumerate() {
        if association.track_of[i].is_none()
            && eligibility.crowding.is_evidence(claim)
            && let Some(id) = claim.before.track
            && hit.iter().any(|t| t.id == id && !identity.refuses(claim, t))
            && !association.contains(id)
            && !claim.is_provisional()
        {
            association.assign(i, id);
        }
    }
    association
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::super::detection::fixture::detection;
    use super::*;
    use crate::claims::{self, Store};
    use crate::monitor::alert_lifecycle::AlertLifecycle;
    use crate::monitor::config::Config;
    use crate::monitor::input::claim_state::fixture::active_claim;
    use crate::monitor::input::claim_timing::ClaimTiming;
    use crate::monitor::input::crowding::Crowding;

    fn tracker(frames: &[&[f64]]) -> Tracker {
        let mut tracker = Tracker::new(50.0);
        for (k, places) in frames.iter().enumerate() {
            let detections: Vec<_> = places.iter().map(|&x| detection(x, 0.0)).collect();
            tracker.step(Timestamp::from_millisecond(100 * k as i64).unwrap(), &detections, 0.1);
        }
        tracker
    }

    /// The track of each claim, where few names are claimed.
    fn ids(claims: &[ActiveClaim], tracker: &Tracker) -> Vec<Option<u64>> {
        let eligibility = Eligibility {
            now: None,
            config: &Config::default(),
            timing: &ClaimTiming::default(),
            crowding: Crowding::default(),
            alerts: &AlertLifecycle::new("replay".into(), None, 60.0),
            of_lights: &BTreeSet::new(),
            store: &Store::new(&claims::Config::default()),
        };
        associate(claims, tracker, &eligibility).track_of
    }

    /// A claim of a user at (`x`, 0) whose beam was `track`.
    fn known(x: f64, track: u64) -> ActiveClaim {
        let mut claim = active_claim("a", x, 0.0);
        claim.before.found(track);
        claim
    }

    #[test]
    fn each_claim_has_the_beam_near_it() {
        let tracker = tracker(&[&[0.0, 30.0]]);
        let claims = [
            active_claim("a", 29.0, 0.0),
            active_claim("b", 1.0, 0.0),
            active_claim("c", 90.0, 0.0),
        ];
        assert_eq!(ids(&claims, &tracker), [Some(2), Some(1), None]);
    }

    #[test]
    fn a_claim_keeps_its_beam_until_another_is_nearer_by_far() {
        let tracker = tracker(&[&[0.0, 4.0]]);
        // Even beside the other beam; not 7 m from its own and 3 m from the other.
        for (x, track) in [(2.3, 1), (4.0, 1), (7.0, 2)] {
            assert_eq!(ids(&[known(x, 1)], &tracker), [Some(track)], "{x}");
        }
    }

    #[test]
    fn users_who_exchange_their_claims_keep_their_beams_unless_these_have_met() {
        for (apart, exchanged) in [(60.0, false), (12.0, false), (2.0, true)] {
            let mut tracker = Tracker::new(50.0);
            for k in 0..50 {
                // From here on 60 m apart, whether they have met or not.
                let x = if k < 20 {
                    apart
                } else {
                    60.0f64.min(apart + f64::from(k - 20) * 2.0)
                };
                let time = Timestamp::from_millisecond(100 * i64::from(k)).unwrap();
                tracker.step(time, &[detection(0.0, 0.0), detection(x, 0.0)], 0.1);
            }
            let now = Timestamp::from_second(5).unwrap();
            let exchanging = [known(60.0, 1), known(0.0, 2)].map(|mut claim| {
                claim.before.first_seen = Some(Timestamp::UNIX_EPOCH);
                claim.before.last_seen = Some(now);
                claim.made = Timestamp::from_millisecond(4900).unwrap();
                claim
            });
            let kept = [Some(1), Some(2)];
            assert_eq!(ids(&exchanging, &tracker) != kept, exchanged, "{apart}");
        }
    }

    #[test]
    fn who_has_gone_on_since_their_claim_does_not_get_the_beam_that_stands_there_now() {
        // The second drives past the first, who claims to be far away, and claims when they are beside each other.
        let frames: Vec<[f64; 2]> = (0..20).map(|k| [0.0, 12.0 - f64::from(k)]).collect();
        let frames: Vec<&[f64]> = frames.iter().map(|f| f.as_slice()).collect();
        let tracker = tracker(&frames);
        let mut driver = known(2.0, 2);
        driver.made = Timestamp::from_millisecond(1000).unwrap();
        (driver.age_s, driver.slack_m) = (0.9, 11.7);
        let mut liar = known(-25.0, 1);
        liar.claim.user = "liar".into();
        (liar.made, liar.slack_m) = (driver.made, 2.7);
        assert_eq!(ids(&[driver, liar], &tracker), [Some(2), Some(1)]);
    }

    #[test]
    fn a_beam_that_drifts_out_of_the_gate_stays_its_users() {
        let tracker = tracker(&[&[40.0]]);
        assert_eq!(ids(&[active_claim("a", 0.0, 0.0)], &tracker), [None]);
        assert_eq!(ids(&[known(0.0, 1)], &tracker), [Some(1)]);
    }

    #[test]
    fn a_beam_just_missed_hands_its_claim_to_nobody() {
        let tracker = tracker(&[&[0.0], &[0.0], &[0.0], &[6.0]]);
        assert_eq!(ids(&[known(3.0, 1)], &tracker), [None]);
        assert_eq!(ids(&[active_claim("a", 3.0, 0.0)], &tracker), [Some(2)]);
    }
}
