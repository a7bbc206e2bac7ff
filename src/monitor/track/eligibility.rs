//! Whether a beam may be that of a user who is not known by one yet: it is near their claim by more than chance, and has not walked
//! onto it.

use std::collections::BTreeSet;

use jiff::Timestamp;
use nalgebra::Vector2;

use super::beam_track::Track;
use crate::claims::Store;
use crate::monitor::alert::AlertKind;
use crate::monitor::alert_lifecycle::AlertLifecycle;
use crate::monitor::config::Config;
use crate::monitor::finding::Cause;
use crate::monitor::input::claim_state::{ActiveClaim, CLAIM_LIFE_S};
use crate::monitor::input::claim_timing::ClaimTiming;
use crate::monitor::input::crowding::Crowding;
use crate::time::seconds;

/// Share of the tolerated distance by which a claim that stays where it is may move: half of it is the error of an honest claim.
const STAYS: f64 = 0.5;
/// Claim periods for which a claim may be associated with a new beam, where they are longer than `claims_stale_s`: one or two
/// claims lost are no silence.
const FRESH_PERIODS: f64 = 5.0;

/// What decides on it.
#[derive(Clone, Copy)]
pub struct Eligibility<'a> {
    /// The newest time so far.
    pub now: Option<Timestamp>,
    pub config: &'a Config,
    pub timing: &'a ClaimTiming,
    pub crowding: Crowding,
    pub alerts: &'a AlertLifecycle,
    /// Tracks of known lights.
    pub of_lights: &'a BTreeSet<u64>,
    pub store: &'a Store,
}

impl Eligibility<'_> {
    /// `owner` is the claim that the track was associated with in the frame before.
    pub fn allows(&self, claim: &ActiveClaim, track: &Track, owner: Option<&ActiveClaim>) -> bool {
        if claim.before.track != Some(track.id) && claim.age_s > self.freshness_s(claim) {
            return false;
        }
        // Who may be hidden beside others, as who may be out of view, is not where a beam comes on elsewhere.
        let must_be_seen = claim.expected && !claim.is_unresolvable;
        let is_anothers = owner.is_some_and(|o| o.claim.user != claim.claim.user);
        let is_known = claim.before.track == Some(track.id) && !claim.is_provisional();
        if !is_known && !must_be_seen && !self.may_have_come(claim, track, owner) {
            return false;
        }
        // Who claims to be where a known light is must bring a beam of their own.
        if self.of_lights.contains(&track.id) {
            return false;
        }
        if claim.before.is_established() {
            return true;
        }
        let is_alerted = self.alerts.is_open(&Cause::Track(track.id));
        if !self.crowding.is_crowded() {
            // No word of a newcomer makes of a stranger who has been told of a user who is elsewhere.
            let is_new = claim.before.track != Some(track.id);
            let would_be_told_otherwise = is_alerted && is_new && !self.may_have_come(claim, track, owner);
            return claim.before.was_seen()
                || !(would_be_told_otherwise
                    || self.has_walked_onto(claim, track)
                    || (is_anothers && self.is_handed_on(claim, owner)));
        }
        // Where the beam was when the claim was made: a newcomer may be on the move.
        let beam = track.at(claim.made).unwrap_or(track.filter.position());
        !is_alerted && !is_anothers && (beam - claim.position).norm() <= self.crowding.reach_m()
    }

    /// Whether who may be out of view, or hidden, can be where the beam is, nearer to it than whose it was.
    fn may_have_come(&self, claim: &ActiveClaim, track: &Track, owner: Option<&ActiveClaim>) -> bool {
        let away_m = |from: &ActiveClaim| (track.filter.position() - from.position).norm();
        let reach_m = claim.reach_m(self.config.tolerated_distance_m);
        away_m(claim) <= owner.map_or(reach_m, |owner| reach_m.min(away_m(owner)))
    }

    /// Age up to which a claim may be associated with a beam that was not its user's before, s: the longer a user is silent, the
    /// wider the ground on which a stranger could appear under their name. While the whole log is silent, old claims are all there
    /// are.
    fn freshness_s(&self, claim: &ActiveClaim) -> f64 {
        if self.alerts.is_open(&Cause::System(AlertKind::ClaimsStale)) {
            return CLAIM_LIFE_S;
        }
        let typical_s = self.timing.period_s().unwrap_or(CLAIM_LIFE_S);
        let period_s = typical_s.max(claim.period_s.unwrap_or(0.0));
        self.config
            .claims_stale_s
            .max(FRESH_PERIODS * period_s)
            .min(CLAIM_LIFE_S)
    }

    /// The beam was nobody's, and alerted, while the claim stood where it is now: the beam came to the claim, not the claim to
    /// the beam.
    fn has_walked_onto(&self, claim: &ActiveClaim, track: &Track) -> bool {
        let Some(raised_at) = self.alerts.raised_at(&Cause::Track(track.id)) else {
            return false;
        };
        let user = &claim.claim.user;
        let was_heard = self.store.first_heard(user).is_some_and(|t| t <= raised_at);
        let then = self.store.position_at(user, raised_at).map(Vector2::from);
        let here = Vector2::new(claim.claim.x_m, claim.claim.y_m);
        was_heard && then.is_some_and(|then| (then - here).norm() <= STAYS * self.config.tolerated_distance_m)
    }

    /// The beam is known by another user's claim, which goes on, and this one has been without a beam for so long that it should
    /// have had one.
    fn is_handed_on(&self, claim: &ActiveClaim, owner: Option<&ActiveClaim>) -> bool {
        let waited_s = |since| self.now.map_or(0.0, |now| seconds(since, now));
        let has_waited = claim
            .before
            .unseen_since
            .is_some_and(|t| waited_s(t) >= self.config.decision_s);
        has_waited && owner.is_some_and(|o| !o.ended && o.before.is_established())
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;
    use crate::monitor::alert::Severity;
    use crate::monitor::finding::{Content, Finding};
    use crate::monitor::fixture::Scene;

    const STRANGER: [f64; 2] = [40.0, 0.0];

    /// A user at the origin who has been known for 3 s, and a stranger, track 2.
    fn scene() -> Scene {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        (0..20).for_each(|_| scene.show(&[[0.0, 0.0], STRANGER]));
        scene
    }

    /// Whether the stranger's beam may be that of `claim`, or the user's, where it is `theirs`.
    fn allows(scene: &Scene, claim: &ActiveClaim, theirs: bool) -> bool {
        let (track, owner) = match theirs {
            true => (1, scene.claims.first()),
            false => (2, None),
        };
        scene
            .eligibility()
            .allows(claim, scene.tracker.get(track).unwrap(), owner)
    }

    fn newcomer(scene: &mut Scene, x: f64) -> ActiveClaim {
        scene.hear("new", x, 0.0)
    }

    #[test]
    fn among_few_names_any_claim_may_be_a_beams() {
        let mut scene = scene();
        let claim = newcomer(&mut scene, 44.0);
        assert!(allows(&scene, &claim, false));
    }

    #[test]
    fn who_claims_to_be_out_of_view_or_may_be_hidden_can_have_come_only_so_far() {
        let mut scene = scene();
        let mut claim = newcomer(&mut scene, STRANGER[0] + 12.0);
        claim.before = scene.claims[0].before;
        assert!(claim.before.is_established() && allows(&scene, &claim, false));
        for (expected, is_unresolvable) in [(false, false), (true, true)] {
            (claim.expected, claim.is_unresolvable, claim.slack_m) = (expected, is_unresolvable, 0.0);
            assert!(!allows(&scene, &claim, false));
            claim.slack_m = 7.0;
            assert!(allows(&scene, &claim, false));
        }
    }

    #[test]
    fn among_many_only_one_that_is_right_to_the_metre() {
        let mut scene = scene();
        scene.crowd(300.0);
        let reach = scene.crowding.reach_m();
        for (off, is_allowed) in [(0.9 * reach, true), (1.1 * reach, false)] {
            let claim = newcomer(&mut scene, STRANGER[0] + off);
            assert_eq!(allows(&scene, &claim, false), is_allowed, "{off}");
        }
        // A beam that has been theirs for three seconds stays theirs.
        let mut known = newcomer(&mut scene, 60.0);
        known.before = scene.claims[0].before;
        assert!(known.before.is_established() && allows(&scene, &known, false));
    }

    #[test]
    fn a_beam_that_was_alerted_before_it_came_to_the_claim_has_walked_onto_it() {
        let mut scene = scene();
        let stood = newcomer(&mut scene, 40.0);
        scene.now += SignedDuration::from_secs(1);
        let content = Content::new(Severity::Warning, serde_json::json!({}));
        scene.apply(vec![Finding::present(Cause::Track(2), content)]);
        scene.now += SignedDuration::from_secs(1);
        assert!(!allows(&scene, &stood, false));
        // One who is heard later, or was claimed elsewhere then, came to the beam.
        let later = scene.hear("later", 40.0, 0.0);
        assert!(allows(&scene, &later, false));
        let moved = newcomer(&mut scene, 45.4);
        assert!(allows(&scene, &moved, false));
    }

    #[test]
    fn an_alerted_beam_is_that_of_a_newcomer_near_it_only() {
        let mut scene = scene();
        scene.now += SignedDuration::from_secs(1);
        let content = Content::new(Severity::Warning, serde_json::json!({}));
        scene.apply(vec![Finding::present(Cause::Track(2), content)]);
        scene.now += SignedDuration::from_secs(1);
        for (off, is_allowed) in [(4.0, true), (12.0, false), (25.0, false)] {
            let claim = scene.hear(&format!("{off} m off"), STRANGER[0] + off, 0.0);
            assert_eq!(allows(&scene, &claim, false), is_allowed, "{off}");
        }
    }

    #[test]
    fn a_known_users_beam_is_not_handed_on_to_one_who_should_have_had_one() {
        let mut scene = scene();
        let mut claim = newcomer(&mut scene, 1.0);
        assert!(allows(&scene, &claim, true));
        claim.before.unseen_since = Some(scene.now - SignedDuration::from_secs(1));
        assert!(!allows(&scene, &claim, true));
        scene.claims[0].ended = true;
        assert!(allows(&scene, &claim, true));
    }

    #[test]
    fn an_old_claim_may_be_no_new_beams() {
        let mut scene = scene();
        let mut claim = newcomer(&mut scene, 40.0);
        let mut is_allowed = |age_s: f64, period_s: f64, scene: &Scene| {
            (claim.age_s, claim.period_s) = (age_s, Some(period_s));
            allows(scene, &claim, false)
        };
        // Five seconds, or five of its user's periods.
        assert!(is_allowed(5.0, 1.0, &scene) && !is_allowed(5.1, 1.0, &scene));
        assert!(is_allowed(10.0, 2.0, &scene) && !is_allowed(10.1, 2.0, &scene));
        // While the whole log is silent, a minute.
        let silence = Content::new(Severity::Warning, serde_json::json!({}));
        scene.apply(vec![Finding::present(Cause::System(AlertKind::ClaimsStale), silence)]);
        assert!(is_allowed(60.0, 1.0, &scene) && !is_allowed(60.1, 1.0, &scene));
    }
}
