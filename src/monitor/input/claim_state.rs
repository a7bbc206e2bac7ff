//! The active claims of a frame: where each puts its user, how exactly, and whether a beam must be seen there.

use jiff::{SignedDuration, Timestamp};
use nalgebra::{Matrix2, Vector2};

use crate::claims::{Beam, Bearing, Claim, ClaimState, Standing, Store};

use crate::geo::View;
use crate::monitor::config::Config;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::monitor::track::detection::{OVERLAP, spot_m};
use crate::monitor::track::user_track::UserTrack;
use crate::time::seconds;

/// Speed at which a user may leave their last claim without a new one, beyond the one they claimed, m/s: a walk. Larger widens
/// what is tolerated between claims, smaller raises a mismatch for who sets off. Not measured.
const FREE_SPEED_M_S: f64 = 3.0;
/// Largest claimed speed that widens what is tolerated, m/s: an attacker writes it. Smaller raises mismatches for users in cars.
const MAX_SPEED_M_S: f64 = 20.0;
/// Age past which a claim is associated only with a beam that is already known to be its user's, s. Longer lets an old claim cover
/// for a stranger, shorter makes strangers of users who seldom claim. Not measured.
pub const CLAIM_LIFE_S: f64 = 60.0;
/// Smallest standard deviation of a claim that is believed, m. A fifth of what is systematic in positions: a claim without any
/// error changes nothing more.
const MIN_SIGMA_M: f64 = 0.01;
/// Largest movement since a claim, m, that widens the association: beyond it every beam would do. Half of it is a standard
/// deviation: 30 m. Not measured.
const MAX_SLACK_M: f64 = 60.0;

/// A user's newest claim as it bears on the frame at hand.
#[derive(Clone, Debug)]
pub struct ActiveClaim {
    pub claim: Claim,
    /// Where the claim puts the beam on the ground as the camera sees it, m.
    pub claimed: Vector2<f64>,
    /// The same, moved by our own pose error once the frame has shown it.
    pub position: Vector2<f64>,
    /// Covariance of the claim, m².
    pub cov: Matrix2<f64>,
    /// Variance along its worst direction, m².
    pub variance: f64,
    /// The same of our own pose at the claimed place, along its worst axis, m²; zero for a fixed platform.
    pub pose_variance: f64,
    /// When the claim was made, by our clock; never after the frame.
    pub made: Timestamp,
    /// Age of the claim, s.
    pub age_s: f64,
    /// How far the user may have gone since, m.
    pub slack_m: f64,
    /// The beam must be seen if the claim holds.
    pub expected: bool,
    /// The beam had to be seen when the claim was made, and its user may have gone out of view since.
    pub may_have_left: bool,
    pub ended: bool,
    /// The user's own beam is not seen, and one at the claimed place would not be resolved from its neighbours.
    pub is_unresolvable: bool,
    /// Seconds between the user's last two claims.
    pub period_s: Option<f64>,
    pub came: Timestamp,
    /// The user's beam as it was known before this frame.
    pub before: UserTrack,
}

/// What decides which claims bear on a frame.
#[derive(Clone, Copy, Debug)]
pub struct Scope<'a> {
    pub config: &'a Config,
    pub view: &'a View,
    /// Standard deviation of claims that state none, m.
    pub default_sigma_m: f64,
    /// Seconds by which the log's clock is ahead of ours.
    pub clock_offset_s: f64,
}

/// The claims that bear on a frame at `now`, by user: those in or near the view, and those of users whose beam `is_followed`. The
/// store chooses which of them the frame has time for: those of known users, and of the others those nearest to a beam. `user`
/// gives what is known of a user's beam.
pub fn active_claims(
    store: &mut Store,
    now: Timestamp,
    scope: Scope,
    beams: &[Beam],
    user: impl Fn(&str) -> Option<UserTrack>,
    is_followed: impl Fn(u64) -> bool,
) -> Vec<ActiveClaim> {
    store.choose(beams, |standing| {
        scope.bearing(standing, &Reach::of(standing, now, &scope))
    });
    let mut claims: Vec<ActiveClaim> = store
        .chosen()
        .filter_map(|standing| {
            let (reach, user) = (
                Reach::of(&standing, now, &scope),
                user(&standing.claim.user).unwrap_or_default(),
            );
            let is_active = standing.claim.state == ClaimState::Active;
            let bears =
                (is_active && user.track.is_some_and(&is_followed)) || scope.bearing(&standing, &reach).is_some();
            bears.then(|| ActiveClaim::new(&standing, reach, user, &scope))
        })
        .collect();
    for claim in &mut claims {
        claim.expected = !claim.ended && scope.must_be_seen(claim, claim.slack_m);
        claim.may_have_left = !claim.ended && !claim.expected && scope.must_be_seen(claim, 0.0);
    }
    claims.sort_by(|a, b| a.claim.user.cmp(&b.claim.user));
    claims
}

/// Whether the user is among `claims`, which are by user.
pub fn has_claim(claims: &[ActiveClaim], user: &str) -> bool {
    claims
        .binary_search_by(|claim| claim.claim.user.as_str().cmp(user))
        .is_ok()
}

/// What a claim's age and stated error make of the place it names.
#[derive(Clone, Copy, Debug)]
struct Reach {
    made: Timestamp,
    age_s: f64,
    cov: Matrix2<f64>,
    slack_m: f64,
}

impl Reach {
    /// A claim's own error is believed only up to the tolerated distance: a lie there must not hide a lie about the place.
    fn of(standing: &Standing, now: Timestamp, scope: &Scope) -> Self {
        let claim = standing.claim;
        let offset = SignedDuration::from_millis((scope.clock_offset_s * 1e3).round() as i64);
        let made = claim.time.saturating_sub(offset).map_or(now, |made| made.min(now));
        let age_s = seconds(made, now);
        let believed = |sigma: f64| sigma.clamp(MIN_SIGMA_M, scope.config.tolerated_distance_m);
        let cov = match claim.cov_m2 {
            Some(stated) => believed_cov(&stated, believed),
            None => Matrix2::identity() * believed(claim.sigma_m.unwrap_or(scope.default_sigma_m)).powi(2),
        };
        Self {
            made,
            age_s,
            cov,
            slack_m: (FREE_SPEED_M_S + standing.pace_m_s.min(MAX_SPEED_M_S)) * age_s,
        }
    }
}

/// A stated covariance with both its standard deviations as far as they are believed.
fn believed_cov([[a, b], [_, c]]: &[[f64; 2]; 2], believed: impl Fn(f64) -> f64) -> Matrix2<f64> {
    let mut axes = Matrix2::new(*a, *b, *b, *c).symmetric_eigen();
    axes.eigenvalues
        .apply(|variance| *variance = believed(variance.max(0.0).sqrt()).powi(2));
    axes.recompose()
}

impl Scope<'_> {
    /// How a claim bears on the view, if it does. A beam in view agrees only with a claim that is in view but for what is tolerated
    /// and the claim's own error; how far the user may have gone since widens only what the claim may be associated with.
    fn bearing(&self, standing: &Standing, reach: &Reach) -> Option<Bearing> {
        let claim = standing.claim;
        let place = self.view.apparent(claim.x_m, claim.y_m, claim.z_m);
        let pose_m = 3.0 * self.pose_std_m(place);
        let is_near = |margin_m: f64| is_near_view(self.view, place, margin_m + pose_m);
        let sigmas_m = 5.0 * largest_eigenvalue(&reach.cov).sqrt();
        let reach_m = self.config.tolerated_distance_m + reach.slack_m + sigmas_m;
        let bears = match claim.state {
            ClaimState::Ended => reach.age_s <= self.config.ended_grace_s,
            ClaimState::Active => reach.age_s <= CLAIM_LIFE_S && is_near(reach_m + spot_m(self.view) * OVERLAP),
        };
        let is_in_view = is_near(self.config.tolerated_distance_m + sigmas_m);
        bears.then_some(if is_in_view { Bearing::InView } else { Bearing::Beyond })
    }

    /// Standard deviation of a place by our own pose, along its worst axis, m.
    fn pose_std_m(&self, p: Vector2<f64>) -> f64 {
        largest_eigenvalue(&self.view.pose_cov(p)).max(0.0).sqrt()
    }

    /// Whether even a user as far off as is tolerated, who has gone `gone_m` since the claim, would show at least part of a spot.
    fn must_be_seen(&self, claim: &ActiveClaim, gone_m: f64) -> bool {
        let off = claim.reach_m(self.config.tolerated_distance_m) - claim.slack_m + gone_m;
        is_near_view(self.view, claim.position, (spot_m(self.view) - off).min(0.0))
            && self.view.is_ground_known(claim.position, off)
    }
}

impl ActiveClaim {
    /// Whether the user's beam was taken up when they claimed to be beyond the view, as they do still: it is theirs while it may be.
    pub fn is_provisional(&self) -> bool {
        self.before.is_provisional && !self.expected
    }

    fn new(standing: &Standing, reach: Reach, before: UserTrack, scope: &Scope) -> Self {
        let claim = standing.claim;
        let position = scope.view.apparent(claim.x_m, claim.y_m, claim.z_m);
        Self {
            claimed: position,
            position,
            variance: largest_eigenvalue(&reach.cov),
            cov: reach.cov,
            pose_variance: scope.pose_std_m(position).powi(2),
            made: reach.made,
            age_s: reach.age_s,
            slack_m: reach.slack_m,
            expected: false,
            may_have_left: false,
            is_unresolvable: false,
            ended: claim.state == ClaimState::Ended,
            period_s: standing.period_s,
            came: standing.came,
            before,
            claim: claim.clone(),
        }
    }

    /// How far from the claim its user's beam may be seen, m.
    pub fn reach_m(&self, tolerated_m: f64) -> f64 {
        tolerated_m + self.slack_m + 3.0 * (self.variance.sqrt() + self.pose_variance.sqrt())
    }

    /// Covariance for the association with a beam: half of what the user may have gone and may be off counts as a standard
    /// deviation.
    pub fn association_cov(&self, tolerated_m: f64, gone_m: f64) -> Matrix2<f64> {
        let slack = 0.5 * gone_m.min(MAX_SLACK_M);
        let isotropic = |variance: f64| Matrix2::identity() * variance;
        let tolerated = isotropic(0.25 * tolerated_m * tolerated_m);
        self.cov + isotropic(self.pose_variance) + isotropic(slack * slack) + tolerated
    }
}

/// Whether a place is in view, or beyond its edge by less than this.
pub fn is_near_view(view: &View, p: Vector2<f64>, margin_m: f64) -> bool {
    let camera = &view.camera;
    let [x, y] = view.to_sensor([p.x, p.y]);
    let margin = margin_m / view.ground_scale();
    x.abs() <= camera.x.half_width() + margin && y.abs() <= camera.y.half_width() + margin
}

#[cfg(test)]
pub mod fixture {
    use super::*;

    /// A claim of 0.3 m, made in this very moment, of a user whose beam is expected at (`x`, `y`), m.
    pub fn active_claim(user: &str, x: f64, y: f64) -> ActiveClaim {
        let claim = Claim {
            time: Timestamp::UNIX_EPOCH,
            user: user.into(),
            x_m: x,
            y_m: y,
            z_m: None,
            sigma_m: Some(0.3),
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        };
        ActiveClaim {
            claimed: Vector2::new(x, y),
            position: Vector2::new(x, y),
            cov: Matrix2::identity() * 0.09,
            variance: 0.09,
            pose_variance: 0.0,
            made: claim.time,
            age_s: 0.0,
            slack_m: 0.0,
            expected: true,
            may_have_left: false,
            ended: false,
            is_unresolvable: false,
            period_s: Some(1.0),
            came: claim.time,
            before: UserTrack::default(),
            claim,
        }
    }
}

#[cfg(test)]
#[path = "claim_state_test.rs"]
mod tests;
