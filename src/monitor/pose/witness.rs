//! The claims that our own pose is estimated from: where each user's beam may be now.

use nalgebra::Vector2;

use super::bias::Residual;
use crate::geo::{PoseError, View};
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::track::tracker::Tracker;

/// Users that have been seen, from which on only such ones count: claims that no beam ever answered say nothing of our pose. As
/// many as must agree on a shift.
const MIN_KNOWN: usize = 3;
/// Reach of a witness, m: a margin for the beam's own error, standard deviations of the claim, and a share of what the user may
/// have gone, up to a bound. Larger lets a beam nearby count, smaller loses honest users. Not measured.
const REACH_M: f64 = 0.5;
const REACH_SIGMAS: f64 = 3.0;
const REACH_SLACK: f64 = 0.3;
const MAX_SLACK_M: f64 = 10.0;

/// A claim and how far from it an honest user's beam may be found now, m.
#[derive(Clone, Copy, Debug)]
pub struct Witness {
    pub claimed: Vector2<f64>,
    /// Per axis, m².
    pub variance: f64,
    pub reach_m: f64,
}

impl Witness {
    /// A claim, and how far its user's beam is known to have `moved` since it was made, m.
    fn of(claim: &ActiveClaim, moved: Option<Vector2<f64>>) -> Self {
        let step_m = match moved {
            Some(_) => 0.0,
            None => REACH_SLACK * claim.slack_m.min(MAX_SLACK_M),
        };
        Self {
            claimed: claim.claimed + moved.unwrap_or_default(),
            variance: claim.variance,
            reach_m: REACH_M + REACH_SIGMAS * claim.variance.sqrt() + claim.pose_variance.sqrt() + step_m,
        }
    }
}

/// Witnesses of all users whose beam is expected, or followed where a wrong pose says that it is out of view; only of those that have been
/// seen, where there are enough.
pub fn witnesses(claims: &[ActiveClaim], tracker: &Tracker) -> Vec<Witness> {
    let is_followed = |a: &ActiveClaim| {
        let track = a.before.current().and_then(|id| tracker.get(id));
        !a.ended && track.is_some_and(|t| t.hit && t.confirmed)
    };
    let heard = claims.iter().filter(|a| a.expected || is_followed(a));
    let (known, new): (Vec<&ActiveClaim>, Vec<&ActiveClaim>) = heard.partition(|a| a.before.was_seen());
    let heard = if known.len() >= MIN_KNOWN {
        known
    } else {
        [known, new].concat()
    };
    let moved = |a: &ActiveClaim| {
        let track = tracker.get(a.before.track?)?;
        Some(track.filter.position() - track.at(a.made)?)
    };
    heard.into_iter().map(|a| Witness::of(a, moved(a))).collect()
}

/// The claims whose own beam is followed and stands alone, each with how far the beam is from it, linearised at a lasting `error` of
/// the pose.
pub fn residuals(claims: &[ActiveClaim], tracker: &Tracker, view: &View, error: &PoseError) -> Vec<Residual> {
    let residual = |a: &ActiveClaim| {
        let track = tracker.get(a.before.current()?)?;
        let is_clear = track.hit && track.confirmed && track.unresolved_from.is_none() && !a.ended;
        let here = track.filter.position();
        let claimed = a.claimed + (here - track.at(a.made)?);
        is_clear.then(|| {
            let expected = view.displaced(claimed, error);
            let by_pose = view.by_pose(expected);
            Residual {
                offset: here - expected + by_pose * error.vector(),
                variance: a.variance + 0.5 * track.filter.position_cov().trace(),
                by_pose,
            }
        })
    };
    claims.iter().filter_map(residual).collect()
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::monitor::fixture::Scene;
    use crate::monitor::input::claim_state::fixture::active_claim;

    #[test]
    fn a_witness_reaches_as_far_as_its_user_may_have_gone() {
        let mut claim = active_claim("a", 3.0, 4.0);
        claim.slack_m = 2.0;
        let unknown = Witness::of(&claim, None);
        assert!((unknown.reach_m - (0.5 + 0.9 + 0.6)).abs() < 1e-12);
        let followed = Witness::of(&claim, Some(Vector2::new(1.0, 0.0)));
        assert!((followed.reach_m - 1.4).abs() < 1e-12);
        assert_eq!(followed.claimed, Vector2::new(4.0, 4.0));
    }

    #[test]
    fn once_three_users_have_been_seen_invented_ones_are_no_witnesses() {
        let mut claims: Vec<_> = ["a", "b", "c", "d", "e"]
            .iter()
            .map(|user| active_claim(user, 0.0, 0.0))
            .collect();
        claims[4].expected = false;
        for (seen, heard) in [(2, 4), (3, 3)] {
            for claim in &mut claims[..seen] {
                claim.before.last_seen = Some(Timestamp::UNIX_EPOCH);
            }
            assert_eq!(witnesses(&claims, &Tracker::new(50.0)).len(), heard);
        }
    }

    #[test]
    fn a_user_whose_beam_is_followed_is_a_witness_though_a_wrong_pose_says_out_of_view() {
        let places = [[0.0, 0.0], [50.0, 0.0], [0.0, 50.0]];
        let mut scene = Scene::of_users(&places);
        scene.claims[1].expected = false;
        scene.show(&places);
        assert_eq!(witnesses(&scene.claims, &scene.tracker).len(), 3);
        scene.show(&[places[0], places[2]]);
        assert_eq!(witnesses(&scene.claims, &scene.tracker).len(), 2);
    }
}
