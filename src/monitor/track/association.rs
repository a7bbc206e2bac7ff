//! Which track is associated with which user's claim, in one frame and from frame to frame.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use super::eligibility::Eligibility;
use super::tracker::{Track, Tracker};
use super::user_track::UserTrack;
use crate::assign::assign;
use crate::claims::seconds;
use crate::monitor::input::claim_state::{ActiveClaim, CLAIM_LIFE_S};
use crate::monitor::stats::gaussian::mahalanobis2;

/// Squared Mahalanobis distance within which a beam can be associated with a claim: χ² of two degrees exceeds it 4 times in 10⁶.
const GATE: f64 = 25.0;
/// What an assignment must gain in squared Mahalanobis distance before a claim changes its beam. Larger keeps a wrong pair for
/// longer, smaller swaps users who pass each other. Not measured.
const INCUMBENCY: f64 = 4.0;
/// Claim periods for which a claim may be associated with a new beam, where they are longer than `claims_stale_s`: one or two
/// claims lost are no silence.
const FRESH_PERIODS: f64 = 5.0;
/// Probability that a beam in view is missed in a frame, at the worst. Assumed; the stories' beams are missed in 0.2 to 3 %.
const MISS_PROBABILITY: f64 = 0.1;
/// ln likelihood ratio from which a user counts as vanished: three frames in a row.
const VANISHED: f64 = 6.9;
/// A beam and an absence that began within this of each other have one cause, s. Longer takes a stranger for a user who happens to
/// go, shorter makes two alerts of one user who answers from elsewhere. Not measured.
pub const COINCIDENCE_S: f64 = 1.5;

/// The track of each active claim in one frame.
#[derive(Clone, Debug, Default)]
pub struct Association {
    track_of: Vec<Option<u64>>,
    associated: BTreeSet<u64>,
}

/// What bounds an association.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    pub tolerated_m: f64,
    pub claims_stale_s: f64,
    /// Typical seconds between a user's claims.
    pub period_s: Option<f64>,
    /// The whole log is silent, so that old claims are all there are.
    pub is_log_stale: bool,
}

/// The beam of every user with an active claim or an open alert.
#[derive(Debug, Default)]
pub struct UserTracks(BTreeMap<String, UserTrack>);

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

    /// Whether a claim is associated with this track.
    pub fn contains(&self, track: u64) -> bool {
        self.associated.contains(&track)
    }

    pub fn assign(&mut self, i: usize, track: u64) {
        self.track_of[i] = Some(track);
        self.associated.insert(track);
    }
}

/// Near pairs by optimal assignment, then the beam that a claim was associated with before, however far it drifted.
///
/// This is the one place where claims meet tracks, at a cost of claims × tracks; `claims::Store::choose` bounds the claims.
pub fn associate(claims: &[ActiveClaim], tracker: &Tracker, limits: &Limits, eligibility: &Eligibility) -> Association {
    // Whose claim each track was associated with in the frame before.
    let owners: BTreeMap<u64, &ActiveClaim> = claims.iter().filter_map(|a| Some((a.before.current()?, a))).collect();
    let hit: Vec<&Track> = tracker.tracks.iter().filter(|t| t.hit).collect();
    let merged: Vec<&Track> = tracker.tracks.iter().filter(|t| t.merged_into.is_some()).collect();
    // A frame that misses a user's beam must not let another beam nearby pass for it.
    let is_held = |a: &ActiveClaim| {
        let track = a.before.track.and_then(|id| tracker.get(id));
        track.is_some_and(Track::is_just_missed)
    };
    let held: Vec<bool> = claims.iter().map(is_held).collect();
    let mut association = Association::none(claims.len());
    for tracks in [&hit, &merged] {
        let open: Vec<usize> = (0..claims.len())
            .filter(|&i| association.track_of[i].is_none() && !held[i])
            .collect();
        let matching = assign(open.len(), tracks.len(), GATE + INCUMBENCY, |i, j| {
            let (claim, track) = (&claims[open[i]], tracks[j]);
            let offset = track.filter.position() - claim.position;
            let d2 = mahalanobis2(
                offset,
                track.filter.position_cov() + claim.association_cov(limits.tolerated_m),
            );
            if d2 > GATE {
                return f64::INFINITY;
            }
            let is_incumbent = claim.before.track == Some(track.id);
            let is_too_old = !is_incumbent && claim.age_s > limits.freshness_s(claim);
            if is_too_old || !eligibility.allows(claim, track, owners.get(&track.id).copied()) {
                f64::INFINITY
            } else if is_incumbent {
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
            && hit.iter().any(|t| t.id == id)
            && !association.contains(id)
        {
            association.assign(i, id);
        }
    }
    association
}

impl Limits {
    /// Age up to which a claim may be associated with a beam that was not its user's before, s: the longer a user is silent, the
    /// wider the ground on which a stranger could appear under their name.
    fn freshness_s(&self, claim: &ActiveClaim) -> f64 {
        if self.is_log_stale {
            return CLAIM_LIFE_S;
        }
        let period = self.period_s.unwrap_or(CLAIM_LIFE_S).max(claim.period_s.unwrap_or(0.0));
        self.claims_stale_s.max(FRESH_PERIODS * period).min(CLAIM_LIFE_S)
    }
}

impl UserTracks {
    pub fn get(&self, user: &str) -> Option<&UserTrack> {
        self.0.get(user)
    }

    /// The last track of every user.
    pub fn tracks(&self) -> impl Iterator<Item = u64> {
        self.0.values().filter_map(|u| u.track)
    }

    /// Takes a frame's association: who is seen, and who is absent although they are expected.
    pub fn update(&mut self, claims: &[ActiveClaim], association: &Association, now: Timestamp) {
        for (i, claim) in claims.iter().enumerate() {
            let user = self.user(&claim.claim.user);
            if let Some(track) = association.track_id(i) {
                user.found(track);
                user.first_seen.get_or_insert(now);
                user.last_seen = Some(now);
            } else if !claim.expected || claim.is_unresolvable {
                user.unseen_since = None;
                user.absence = 0.0;
            } else {
                user.unseen_since.get_or_insert(now);
                user.absence += (1.0f64 / MISS_PROBABILITY).ln();
            }
        }
    }

    /// The claim of the user whom a beam that has had no claim since `since` may belong to: one who vanished as it appeared, or
    /// the only one who has not been seen yet. Where several have not been seen, which of them it is would be a guess, and the
    /// beam is nobody's. Users whose absence `is_alerted` are not looked for.
    pub fn displaced(
        &self,
        since: Timestamp,
        claims: &[ActiveClaim],
        association: &Association,
        is_alerted: impl Fn(&str) -> bool,
    ) -> Option<usize> {
        let candidates = (0..claims.len())
            .filter(|&i| association.track_id(i).is_none() && claims[i].expected)
            .filter_map(|i| {
                let user = self.get(&claims[i].claim.user)?;
                let gap = seconds(user.unseen_since?, since).abs();
                (user.absence >= VANISHED && gap <= COINCIDENCE_S).then_some((i, gap))
            })
            .filter(|(i, _)| !is_alerted(&claims[*i].claim.user));
        let (known, new): (Vec<_>, Vec<_>) =
            candidates.partition(|(i, _)| self.get(&claims[*i].claim.user).is_some_and(UserTrack::was_seen));
        let candidates = if known.is_empty() && new.len() == 1 { new } else { known };
        let nearest = candidates.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.map(|(i, _)| i)
    }

    /// The user's beam is `track`, found elsewhere.
    pub fn relocate(&mut self, user: &str, track: u64) {
        self.user(user).found(track);
    }

    fn user(&mut self, user: &str) -> &mut UserTrack {
        if !self.0.contains_key(user) {
            self.0.insert(user.to_owned(), UserTrack::default());
        }
        self.0.get_mut(user).expect("inserted if it was absent")
    }

    pub fn retain(&mut self, is_kept: impl Fn(&str) -> bool) {
        self.0.retain(|user, _| is_kept(user));
    }
}

#[cfg(test)]
mod tests {
    use super::super::detection::fixture::detection;
    use super::*;
    use crate::claims::{self, Store};
    use crate::monitor::alert_lifecycle::AlertLifecycle;
    use crate::monitor::input::claim_state::fixture::active_claim;
    use crate::monitor::input::crowding::Crowding;

    fn at(frame: i64) -> Timestamp {
        Timestamp::from_millisecond(100 * frame).unwrap()
    }

    fn tracker(frames: &[&[f64]]) -> Tracker {
        let mut tracker = Tracker::new(50.0);
        for (k, places) in frames.iter().enumerate() {
            let detections: Vec<_> = places.iter().map(|&x| detection(x, 0.0)).collect();
            tracker.step(at(k as i64), &detections, 0.1);
        }
        tracker
    }

    const LIMITS: Limits = Limits {
        tolerated_m: 5.0,
        claims_stale_s: 5.0,
        period_s: Some(1.0),
        is_log_stale: false,
    };

    /// The track of each claim, where few names are claimed.
    fn ids(claims: &[ActiveClaim], tracker: &Tracker, limits: &Limits) -> Vec<Option<u64>> {
        let eligibility = Eligibility {
            now: None,
            crowding: Crowding::default(),
            alerts: &AlertLifecycle::new("replay".into(), None, 60.0),
            store: &Store::new(&claims::Config::default()),
            decision_s: 1.0,
            tolerated_m: limits.tolerated_m,
        };
        associate(claims, tracker, limits, &eligibility).track_of
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
        assert_eq!(ids(&claims, &tracker, &LIMITS), [Some(2), Some(1), None]);
    }

    #[test]
    fn a_claim_keeps_its_beam_until_another_is_nearer_by_far() {
        let tracker = tracker(&[&[0.0, 4.0]]);
        // Even beside the other beam; not 7 m from its own and 3 m from the other.
        for (x, track) in [(2.3, 1), (4.0, 1), (7.0, 2)] {
            assert_eq!(ids(&[known(x, 1)], &tracker, &LIMITS), [Some(track)], "{x}");
        }
    }

    #[test]
    fn a_beam_that_drifts_out_of_the_gate_stays_its_users() {
        let tracker = tracker(&[&[40.0]]);
        assert_eq!(ids(&[active_claim("a", 0.0, 0.0)], &tracker, &LIMITS), [None]);
        assert_eq!(ids(&[known(0.0, 1)], &tracker, &LIMITS), [Some(1)]);
    }

    #[test]
    fn a_beam_just_missed_hands_its_claim_to_nobody() {
        let tracker = tracker(&[&[0.0], &[0.0], &[0.0], &[6.0]]);
        assert_eq!(ids(&[known(3.0, 1)], &tracker, &LIMITS), [None]);
        assert_eq!(ids(&[active_claim("a", 3.0, 0.0)], &tracker, &LIMITS), [Some(2)]);
    }

    #[test]
    fn an_old_claim_is_associated_with_no_new_beam() {
        let tracker = tracker(&[&[0.0]]);
        let mut claim = active_claim("a", 0.0, 0.0);
        claim.age_s = 6.0;
        let of = |limits: &Limits| ids(std::slice::from_ref(&claim), &tracker, limits);
        assert_eq!(of(&LIMITS), [None]);
        // Unless claims are as rare as that, or the whole log is silent.
        let rare = Limits {
            period_s: Some(2.0),
            ..LIMITS
        };
        let silent = Limits {
            is_log_stale: true,
            ..LIMITS
        };
        assert_eq!((of(&rare), of(&silent)), (vec![Some(1)], vec![Some(1)]));
    }

    #[test]
    fn absence_adds_up_while_a_beam_is_expected() {
        let mut users = UserTracks::default();
        let mut claims = [active_claim("a", 0.0, 0.0)];
        let none = Association::none(1);
        for k in 1..4 {
            users.update(&claims, &none, at(k));
        }
        let user = users.get("a").unwrap();
        assert_eq!(user.unseen_since, Some(at(1)));
        assert!((user.absence - 1000f64.ln()).abs() < 1e-9);
        claims[0].is_unresolvable = true;
        users.update(&claims, &none, at(4));
        assert_eq!(users.get("a").unwrap().unseen_since, None);
        let mut seen = Association::none(1);
        seen.assign(0, 7);
        users.update(&claims, &seen, at(5));
        let user = users.get("a").unwrap();
        assert_eq!((user.track, user.last_seen, user.absence), (Some(7), Some(at(5)), 0.0));
        users.retain(|name| name != "a");
        assert!(users.get("a").is_none());
    }

    #[test]
    fn a_new_beam_is_that_of_the_user_who_vanished_as_it_came() {
        let claims = [active_claim("a", 0.0, 0.0), active_claim("b", 50.0, 0.0)];
        let mut users = UserTracks::default();
        let mut both = Association::none(2);
        both.assign(0, 1);
        both.assign(1, 2);
        users.update(&claims, &both, at(0));
        let mut one = Association::none(2);
        one.assign(0, 1);
        for k in 1..4 {
            assert_eq!(users.displaced(at(k), &claims, &one, |_| false), None);
            users.update(&claims, &one, at(k));
        }
        assert_eq!(users.displaced(at(10), &claims, &one, |_| false), Some(1));
        assert_eq!(users.displaced(at(10), &claims, &one, |user| user == "b"), None);
        // It came two seconds after the user went.
        assert_eq!(users.displaced(at(21), &claims, &one, |_| false), None);
    }

    #[test]
    fn of_several_who_were_never_seen_a_beam_is_nobodys() {
        let all = [active_claim("a", 0.0, 0.0), active_claim("b", 50.0, 0.0)];
        for (claims, displaced) in [(&all[..1], Some(0)), (&all[..], None)] {
            let mut users = UserTracks::default();
            let none = Association::none(claims.len());
            (0..3).for_each(|k| users.update(claims, &none, at(k)));
            assert_eq!(users.displaced(at(0), claims, &none, |_| false), displaced);
        }
    }
}
