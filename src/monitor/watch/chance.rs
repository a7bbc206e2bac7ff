//! Whether a beam and a claim belong together, or have met by chance: where many names are claimed without a beam, one of them is near any beam.

use jiff::Timestamp;
use nalgebra::Vector2;

use super::Monitor;
use crate::claims::{Store, seconds};
use crate::monitor::AlertKind;
use crate::monitor::book::Cause;
use crate::monitor::tracks::Track;
use crate::monitor::users::Asserted;

/// Names claimed in view without a beam from which on a claim nearby is no evidence by itself. Honest users have their beams: at the start of a run
/// all of them are without one for a frame or two, and more than this many beams are in no scene.
const CROWDED: f64 = 32.0;
/// Chance, at most, that a beam that has nothing to do with any of the claims meets one of them. One in fifty strangers is believed; of honest newcomers during a flood
/// those whose claim is right to that distance.
const BY_CHANCE: f64 = 0.02;
/// Share of the tolerated distance by which a claim that stays where it is may move.
const STAYS: f64 = 0.5;

/// How near to a beam a name that has no beam yet must be claimed to be believed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crowding {
    /// Names claimed in view that no beam answers, while they are too many.
    names: Option<f64>,
    reach_m: f64,
}

impl Crowding {
    pub fn is_crowded(&self) -> bool {
        self.names.is_some()
    }
}

impl Monitor {
    pub(super) fn crowding(&self, asserted: &[Asserted], claims: &Store, now: Timestamp) -> Crowding {
        let here = asserted.iter().filter(|a| a.expected && !self.was_seen(a)).count();
        let names = here as f64 + claims.left_out() as f64 + claims.dropped_lately(now) as f64;
        if names <= CROWDED {
            return Crowding {
                names: None,
                reach_m: f64::INFINITY,
            };
        }
        let scale = self.camera.ground_scale();
        let area = 4.0 * self.camera.x.half_width() * self.camera.y.half_width() * scale * scale;
        Crowding {
            names: Some(names),
            reach_m: (BY_CHANCE * area / (std::f64::consts::PI * names)).sqrt(),
        }
    }

    fn was_seen(&self, a: &Asserted) -> bool {
        let user = self.users.get(&a.claim.user);
        user.is_some_and(|u| u.last_answered.is_some())
    }

    pub(super) fn is_established(&self, a: &Asserted) -> bool {
        self.users.get(&a.claim.user).is_some_and(|u| u.is_established())
    }

    /// Whether the beam may be taken for that of a user who is not known by one: it is near enough that this is no chance, and has not walked
    /// onto the claim.
    pub(super) fn may_answer(
        &self,
        a: &Asserted,
        track: &Track,
        owner: Option<&Asserted>,
        crowding: &Crowding,
        claims: &Store,
    ) -> bool {
        if crowding.is_crowded() && !self.is_established(a) {
            // Where the beam was when the claim was made: a newcomer may be on the move.
            let beam = track.at(a.made).unwrap_or(track.motion.position());
            let is_alerted = self.book.is_open(&Cause::Track(AlertKind::UnclaimedEmitter, track.id));
            let is_anothers = owner.is_some_and(|o| o.claim.user != a.claim.user);
            return !is_alerted && !is_anothers && (beam - a.position).norm() <= crowding.reach_m;
        }
        self.was_seen(a) || !(self.has_walked_onto(a, track, claims) || self.is_handed_on(a, owner))
    }

    /// The beam was nobody's, and alerted, while the claim stood where it is now: the beam came to the claim, not the claim to the beam.
    fn has_walked_onto(&self, a: &Asserted, track: &Track, claims: &Store) -> bool {
        let cause = Cause::Track(AlertKind::UnclaimedEmitter, track.id);
        let Some(raised_at) = self.book.raised_at(&cause) else {
            return false;
        };
        let stood = claims.first_heard(&a.claim.user).is_some_and(|t| t <= raised_at);
        let then = claims.position_at(&a.claim.user, raised_at).map(Vector2::from);
        let here = Vector2::new(a.claim.x_m, a.claim.y_m);
        stood && then.is_some_and(|then| (then - here).norm() <= STAYS * self.config.tolerated_distance_m)
    }

    /// The beam is known by another user's claim, which goes on, and this one has been without a beam for so long that it should have had one.
    fn is_handed_on(&self, a: &Asserted, owner: Option<&Asserted>) -> bool {
        let waited = self.users.get(&a.claim.user).and_then(|u| u.unanswered_since);
        let has_waited = waited.is_some_and(|since| {
            self.time
                .is_some_and(|now| seconds(since, now) >= self.config.decision_s)
        });
        has_waited && owner.is_some_and(|o| o.claim.user != a.claim.user && !o.ended && self.is_established(o))
    }

    /// Lets the store know whom it must not forget for others. In a crowd one frame's answer is no acquaintance.
    pub(super) fn note_answered(
        &self,
        asserted: &[Asserted],
        answers: &[Option<u64>],
        crowding: &Crowding,
        claims: &mut Store,
        now: Timestamp,
    ) {
        for (a, _) in asserted.iter().zip(answers).filter(|(_, answer)| answer.is_some()) {
            if !crowding.is_crowded() || self.is_established(a) {
                claims.answered(&a.claim.user, now);
            }
        }
    }
}
