//! Which beams are not a known user's, however near to their claims, by what has been seen of both.

use super::beam_track::Track;
use super::eligibility::Eligibility;
use super::tracker::Tracker;
use crate::monitor::finding::Cause;
use crate::monitor::input::claim_state::ActiveClaim;

/// Standard deviations of a claim beyond the tolerated distance from which a user has left a spot that an alerted stranger is in as well. Larger
/// accuses users of the stranger's beam, smaller loses their own to the error of a claim. Not tuned.
const LEFT: f64 = 2.0;

/// What decides on it.
pub struct Identity<'a> {
    pub tracker: &'a Tracker,
    pub eligibility: &'a Eligibility<'a>,
}

impl Identity<'_> {
    /// Whether the user's beam is missed by this frame only, or pauses for no longer than it has of late, as one in bursts does: another beam nearby
    /// must not pass for it.
    pub fn is_held(&self, claim: &ActiveClaim) -> bool {
        let is_in_pause = || self.eligibility.now.is_some_and(|now| claim.before.is_often_away(now));
        let own = self.last_track(claim).filter(|own| !own.is_seen());
        own.is_some_and(|own| own.is_just_missed() || is_in_pause())
    }

    /// Whether the track is somebody else's.
    pub fn refuses(&self, claim: &ActiveClaim, track: &Track) -> bool {
        self.has_own(claim, track) || self.was_beside(claim, track) || self.has_left(claim, track)
    }

    fn last_track(&self, claim: &ActiveClaim) -> Option<&Track> {
        self.tracker.get(claim.before.track?)
    }

    /// A user's beam that goes on is theirs: no claim makes another's of it that it cannot have been taken for.
    fn has_own(&self, claim: &ActiveClaim, track: &Track) -> bool {
        let own = claim.before.current().and_then(|id| self.tracker.get(id));
        let own = own.filter(|own| own.id != track.id && own.hit && own.confirmed && own.unresolved_from.is_none());
        own.is_some_and(|own| claim.before.is_established() && own.is_old() && !own.has_met(track))
    }

    /// Who goes dark is no stranger that was alerted while they shone, unless that one has gone with their claims since.
    fn was_beside(&self, claim: &ActiveClaim, track: &Track) -> bool {
        let raised_at = self.eligibility.alerts.raised_at(&Cause::Track(track.id));
        let (Some(raised_at), Some(seen)) = (raised_at, claim.before.last_seen) else {
            return false;
        };
        let tolerated_m = self.eligibility.config.tolerated_distance_m;
        raised_at <= seen
            && !self.last_track(claim).is_some_and(|own| own.hit)
            && !track.has_gone_with(claim.position, seen, tolerated_m)
    }

    /// When a user's claims leave a spot that an alerted stranger is in as well, or whose light itself is alerted, what stays is not the user's.
    fn has_left(&self, claim: &ActiveClaim, track: &Track) -> bool {
        if claim.before.track != Some(track.id) {
            return false;
        }
        let here = track.filter.position();
        let away_m = (track.at(claim.made).unwrap_or(here) - claim.position).norm();
        let is_here = |t: &&Track| (t.filter.position() - here).norm() <= track.detection.resolution_m;
        let is_alerted = |t: &Track| self.eligibility.alerts.is_open(&Cause::Track(t.id));
        away_m > self.eligibility.config.tolerated_distance_m + LEFT * claim.variance.sqrt()
            && self.tracker.tracks.iter().filter(is_here).any(is_alerted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::alert::Severity;
    use crate::monitor::finding::{Content, Finding};
    use crate::monitor::fixture::Scene;

    /// A user at the origin, track 1, and a stranger at (`x`, 0), track 2, for three seconds; the stranger is alerted or not.
    fn beside(x: f64, is_alerted: bool) -> Scene {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        (0..30).for_each(|_| scene.show(&[[0.0, 0.0], [x, 0.0]]));
        if is_alerted {
            let content = Content::new(Severity::Warning, serde_json::json!({}));
            scene.apply(vec![Finding::present(Cause::Track(2), content)]);
        }
        scene.show(&[[0.0, 0.0], [x, 0.0]]);
        scene
    }

    #[test]
    fn who_goes_dark_is_no_stranger_who_was_alerted_beside_them() {
        for (is_alerted, taken) in [(true, None), (false, Some(2))] {
            let mut scene = beside(6.0, is_alerted);
            assert_eq!(scene.association.track_id(0), Some(1));
            (0..10).for_each(|_| scene.show(&[[6.0, 0.0]]));
            assert_eq!(scene.association.track_id(0), taken);
        }
    }

    #[test]
    fn unless_that_one_goes_with_their_claims() {
        let mut scene = beside(1.0, true);
        for x in 1..12 {
            scene.claim(0, f64::from(x), 0.0);
            (0..5).for_each(|k| scene.show(&[[f64::from(x) + 0.2 * f64::from(k), 0.0]]));
        }
        assert!(scene.association.track_id(0).is_some());
    }

    #[test]
    fn who_shines_in_the_pauses_of_bursts_is_somebody_else() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        for k in 0..40 {
            let (is_on, is_shining) = (k / 5 % 2 == 0, k >= 10);
            match (is_on, is_shining) {
                (true, _) => scene.show(&[[0.0, 0.0]]),
                (false, true) => scene.show(&[[4.0, 0.0]]),
                (false, false) => scene.show(&[]),
            }
            assert_eq!(scene.association.track_id(0), is_on.then_some(1), "{k}");
        }
    }

    #[test]
    fn when_the_claims_go_on_the_light_beside_an_alerted_stranger_is_not_their_users() {
        for (is_alerted, x, kept) in [(true, 8.0, false), (true, 4.0, true), (false, 8.0, true)] {
            let mut scene = beside(1.0, is_alerted);
            scene.claim(0, x, 0.0);
            (0..3).for_each(|_| scene.show(&[[0.0, 0.0], [1.0, 0.0]]));
            assert_eq!(scene.association.track_id(0) == Some(1), kept, "{x}");
        }
    }

    #[test]
    fn a_beam_found_beyond_the_view_is_theirs_while_it_may_be() {
        for (expected, kept) in [(false, false), (true, true)] {
            let mut scene = Scene::of_users(&[[0.0, 0.0]]);
            scene.claims[0].expected = expected;
            (0..20).for_each(|_| scene.show(&[]));
            (0..10).for_each(|_| scene.show(&[[3.0, 0.0]]));
            assert_eq!(scene.association.track_id(0), Some(2));
            scene.claim(0, 12.0, 0.0);
            scene.show(&[[3.0, 0.0]]);
            assert_eq!(scene.association.track_id(0).is_some(), kept);
        }
    }
}
