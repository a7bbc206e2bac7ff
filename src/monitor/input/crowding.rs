//! Whether a beam and a claim belong together, or have met by chance: where many names are claimed without a beam, one of them is near any beam.

use jiff::Timestamp;
use nalgebra::Vector2;

use crate::claims::{Store, seconds};
use crate::monitor::alert::AlertKind;
use crate::monitor::alert_lifecycle::Cause;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::monitor::Monitor;
use crate::monitor::track::tracker::Track;

/// Names claimed in view without a beam from which on a claim nearby is no evidence by itself. Honest users have their beams: at the start of a run
/// all of them are without one for a frame or two, and more than this many beams are in no scene.
const CROWDED: f64 = 32.0;
/// Chance, at most, that a beam that has nothing to do with any of the claims meets one of them. One in fifty strangers is believed; of honest newcomers during a flood
/// those whose claim is right to that distance.
const BY_CHANCE: f64 = 0.02;
/// Share of the tolerated distance by which a claim that stays where it is may move.
const STAYS: f64 = 0.5;

/// Names claimed in view that no beam has answered, and how near to a beam one of them must be claimed to be believed.
#[derive(Clone, Copy, Debug)]
pub struct Crowding {
    is_crowded: bool,
    reach_m: f64,
}

impl Default for Crowding {
    fn default() -> Self {
        Self {
            is_crowded: false,
            reach_m: f64::INFINITY,
        }
    }
}

impl Crowding {
    /// Of `names` anywhere in a view of `area_m2`: the mean number of them within the reach is [`BY_CHANCE`].
    fn of(names: f64, area_m2: f64) -> Self {
        if names <= CROWDED {
            return Self::default();
        }
        Self {
            is_crowded: true,
            reach_m: (BY_CHANCE * area_m2 / (std::f64::consts::PI * names)).sqrt(),
        }
    }

    pub fn is_crowded(&self) -> bool {
        self.is_crowded
    }
}

impl Monitor {
    pub fn crowding_of(&self, active: &[ActiveClaim], claims: &Store, now: Timestamp) -> Crowding {
        let here = active.iter().filter(|a| a.expected && !a.was_seen()).count();
        let elsewhere = claims.left_out() as f64 + claims.dropped_lately(now) as f64;
        let [width, height] =
            [self.camera.x.half_width(), self.camera.y.half_width()].map(|h| 2.0 * h * self.camera.ground_scale());
        Crowding::of(here as f64 + elsewhere, width * height)
    }

    /// Whether the beam may be taken for that of a user who is not known by one: it is near enough that this is no chance, and
    /// has not walked onto the claim. `owner` is whose claim it answered in the frame before.
    pub fn may_answer(&self, a: &ActiveClaim, track: &Track, owner: Option<&ActiveClaim>, claims: &Store) -> bool {
        if a.is_established {
            return true;
        }
        if !self.crowding.is_crowded {
            return a.was_seen() || !(self.has_walked_onto(a, track, claims) || self.is_handed_on(a, owner));
        }
        // Where the beam was when the claim was made: a newcomer may be on the move.
        let beam = track.at(a.made).unwrap_or(track.motion.position());
        let is_alerted = self
            .alerts
            .is_open(&Cause::Track(AlertKind::UnclaimedEmitter, track.id));
        let is_anothers = owner.is_some_and(|o| o.claim.user != a.claim.user);
        !is_alerted && !is_anothers && (beam - a.position).norm() <= self.crowding.reach_m
    }

    /// The beam was nobody's, and alerted, while the claim stood where it is now: the beam came to the claim, not the claim to
    /// the beam.
    fn has_walked_onto(&self, a: &ActiveClaim, track: &Track, claims: &Store) -> bool {
        let cause = Cause::Track(AlertKind::UnclaimedEmitter, track.id);
        let Some(raised_at) = self.alerts.raised_at(&cause) else {
            return false;
        };
        let stood = claims.first_heard(&a.claim.user).is_some_and(|t| t <= raised_at);
        let then = claims.position_at(&a.claim.user, raised_at).map(Vector2::from);
        let here = Vector2::new(a.claim.x_m, a.claim.y_m);
        stood && then.is_some_and(|then| (then - here).norm() <= STAYS * self.config.tolerated_distance_m)
    }

    /// The beam is known by another user's claim, which goes on, and this one has been without a beam for so long that it should
    /// have had one.
    fn is_handed_on(&self, a: &ActiveClaim, owner: Option<&ActiveClaim>) -> bool {
        let waited_s = |since| self.time.map_or(0.0, |now| seconds(since, now));
        let has_waited = a
            .unanswered_since
            .is_some_and(|t| waited_s(t) >= self.config.decision_s);
        has_waited && owner.is_some_and(|o| o.claim.user != a.claim.user && !o.ended && o.is_established)
    }

    /// Lets the store know whom it must not forget for others. Among many names one frame's answer is no acquaintance.
    pub fn note_answered(
        &self,
        active: &[ActiveClaim],
        association: &[Option<u64>],
        claims: &mut Store,
        now: Timestamp,
    ) {
        for (a, _) in active.iter().zip(association).filter(|(_, track)| track.is_some()) {
            if !self.crowding.is_crowded || a.is_established {
                claims.answered(&a.claim.user, now);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_more_names_the_nearer_one_must_be() {
        let view = 250.0 * 250.0;
        assert!(!Crowding::of(32.0, view).is_crowded() && Crowding::of(33.0, view).is_crowded());
        for names in [33.0, 625.0, 20_000.0] {
            let reach = Crowding::of(names, view).reach_m;
            let expected = names * std::f64::consts::PI * reach * reach / view;
            assert!((expected - BY_CHANCE).abs() < 1e-12, "{names}: {expected}");
        }
    }
}
