use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::claims::{Claim, ClaimState, Standing, seconds};
use crate::monitor::input::clock_offset::ClockOffset;
use crate::monitor::pose::displacement::Witness;
use crate::monitor::stats::claim_consistency::ClaimConsistency;
use crate::monitor::stats::co_location::CoLocationTest;

/// A user may leave their last claim by this much a second without a new one, beyond the pace they claimed, m/s.
const FREE_SPEED_M_S: f64 = 3.0;
/// Paces above this are not believed when they widen what is tolerated, m/s.
const FASTEST_M_S: f64 = 20.0;
/// A claim older than this answers for no beam that is not already known to be the user's, s.
pub const CLAIM_LIFE_S: f64 = 60.0;

/// A user's claim as it bears on the frame at hand.
#[derive(Clone, Debug)]
pub struct ActiveClaim {
    pub claim: Claim,
    /// Where the claim puts the beam; our own pose error is added once the frame has told it.
    pub position: Vector2<f64>,
    /// Variance per axis.
    pub variance: f64,
    /// When the claim was made, by our clock; never after the frame.
    pub made: Timestamp,
    /// Age of the claim, s.
    pub age_s: f64,
    /// How far the user may have gone since, m.
    pub slack_m: f64,
    /// The beam must be seen if the claim holds.
    pub expected: bool,
    pub ended: bool,
    /// No beam answers, and one at the claimed place would not be told apart from its neighbours.
    pub is_unresolvable: bool,
    pub period_s: Option<f64>,
    pub came: Timestamp,
    /// As remembered when the frame came: the beam that answered last, the same where it answered in the frame before, since when none
    /// does, when one did last, and whether the user is known by it.
    pub before: Option<u64>,
    pub owns: Option<u64>,
    pub unanswered_since: Option<Timestamp>,
    pub last_answered: Option<Timestamp>,
    pub is_established: bool,
    /// An alert names the user.
    pub has_alert: bool,
}

/// What a claim's age and stated error make of the place it names.
#[derive(Clone, Copy, Debug)]
pub struct Reach {
    /// When the claim was made, by our clock; never after the frame.
    pub made: Timestamp,
    pub age_s: f64,
    /// Variance per axis.
    pub variance: f64,
    /// How far the user may have gone since, m.
    pub slack_m: f64,
}

impl Reach {
    /// `largest_sigma_m` bounds what a claim may say of its own error: a lie there must not hide a lie about the place.
    /// The log's clock is `ahead_s` ahead of ours.
    pub fn of(standing: &Standing, now: Timestamp, default_sigma_m: f64, largest_sigma_m: f64, ahead_s: f64) -> Self {
        let claim = standing.claim;
        let ahead = jiff::SignedDuration::from_millis((ahead_s * 1e3).round() as i64);
        let made = claim.time.saturating_sub(ahead).map_or(now, |made| made.min(now));
        let age_s = seconds(made, now);
        let sigma = claim.sigma_m.unwrap_or(default_sigma_m).clamp(0.01, largest_sigma_m);
        Self {
            made,
            age_s,
            variance: sigma * sigma,
            slack_m: (FREE_SPEED_M_S + standing.pace_m_s.min(FASTEST_M_S)) * age_s,
        }
    }
}

impl ActiveClaim {
    /// `user` is what is remembered of the user when the frame comes.
    pub fn new(standing: &Standing, reach: Reach, user: Option<&User>) -> Self {
        let claim = standing.claim;
        let before = user.and_then(|u| u.track);
        Self {
            position: Vector2::new(claim.x_m, claim.y_m),
            variance: reach.variance,
            made: reach.made,
            age_s: reach.age_s,
            slack_m: reach.slack_m,
            expected: false,
            is_unresolvable: false,
            ended: claim.state == ClaimState::Ended,
            period_s: standing.period_s,
            came: standing.came,
            before,
            owns: before.filter(|_| user.is_some_and(|u| u.unanswered_since.is_none())),
            unanswered_since: user.and_then(|u| u.unanswered_since),
            last_answered: user.and_then(|u| u.last_answered),
            is_established: user.is_some_and(User::is_established),
            has_alert: false,
            claim: claim.clone(),
        }
    }

    /// A beam has answered the user's claims before.
    pub fn was_seen(&self) -> bool {
        self.last_answered.is_some()
    }

    /// The claim as a witness of our own pose: reach for its error and for a step since it was made, where the user's beam
    /// does not tell how far it has `moved` since.
    pub fn witness(&self, moved: Option<Vector2<f64>>) -> Witness {
        let step_m = match moved {
            Some(_) => 0.0,
            None => 0.3 * self.slack_m.min(10.0),
        };
        Witness {
            claimed: Vector2::new(self.claim.x_m, self.claim.y_m) + moved.unwrap_or_default(),
            variance: self.variance,
            reach_m: 0.5 + 3.0 * self.variance.sqrt() + step_m,
        }
    }

    /// Covariance for asking which beam answers the claim.
    pub fn spread(&self, tolerated_m: f64) -> Matrix2<f64> {
        let slack = 0.5 * self.slack_m.min(60.0);
        Matrix2::identity() * (self.variance + slack * slack + 0.25 * tolerated_m * tolerated_m)
    }
}

/// A user whose claim a beam has answered for this long is known by it, s: longer than a chance meeting of two who walk lasts.
const ESTABLISHED_S: f64 = 3.0;

impl User {
    /// A beam has answered the claim for long enough that the two are taken to belong together.
    fn is_established(&self) -> bool {
        let answered = self.first_answered.zip(self.last_answered);
        answered.is_some_and(|(first, last)| seconds(first, last) >= ESTABLISHED_S)
    }
}

/// What the monitor remembers of a user.
#[derive(Clone, Debug, Default)]
pub struct User {
    /// The beam that answered last.
    pub track: Option<u64>,
    pub residuals: ClaimConsistency,
    pub clock: ClockOffset,
    /// First frame since which no beam answers.
    pub unanswered_since: Option<Timestamp>,
    /// ln likelihood ratio of "absent" to "missed by chance".
    pub absence: f64,
    /// Frames in a row with the beam outside what is tolerated.
    pub outside: u32,
    pub first_answered: Option<Timestamp>,
    pub last_answered: Option<Timestamp>,
    pub mismatched: bool,
    /// A beam elsewhere took the user's place when they vanished.
    pub displaced: bool,
    /// Whether the beam is two.
    pub co_location: CoLocationTest,
    /// Since when there are signs that it is: the present is not taken for the past.
    pub suspected_since: Option<Timestamp>,
    /// When an emitter that had its own alert was last beside the beam.
    pub accompanied: Option<Timestamp>,
}
