//! How far the log's clock is off ours, from users on the move: a claim stamped τ too late lies τ·v behind the beam.

use jiff::Timestamp;
use nalgebra::Vector2;

use crate::monitor::by_user::ByUser;
use crate::monitor::frame_context::FrameContext;
use crate::monitor::stats::claim_consistency::COMMON_SHARE;
use crate::monitor::stats::robust::median;

/// Claims of a user that are remembered (exponentially). More make the estimate exact, fewer follow a clock that is being set.
/// Not measured.
const MEMORY: f64 = 64.0;
/// Movers that must show an offset before it is believed: the median of three is moved by no single liar.
const MIN_MOVERS: usize = 3;
/// Standard deviation, s, that a mover's offset must be known to, and the smallest offset that is corrected. Smaller follows
/// noise, larger leaves a wrong clock to the tolerated distance: a quarter of a second is 35 cm of a walk. Not measured.
const RESOLUTION_S: f64 = 0.25;
/// Variance of a beam's position that is added to a claim's, m². 0.1 m r.m.s., more than a fit leaves; larger weighs exact claims
/// less. Not measured.
const BEAM_VARIANCE: f64 = 0.01;
/// Change of the offset from which it is followed, s: each change makes the residuals so far useless. Larger corrects later,
/// smaller forgets residuals more often. Not measured.
const STEP_S: f64 = 0.1;

/// The estimated offset and what each user's claims say of it.
#[derive(Debug, Default)]
pub struct ClockOffset {
    users: ByUser<UserClock>,
    offset_s: f64,
}

/// Sums of a weighted regression of a user's offsets on their velocity, older claims counting less.
#[derive(Clone, Copy, Debug, Default)]
struct UserClock {
    newest: Option<Timestamp>,
    information: f64,
    offset: f64,
    claims: f64,
}

impl ClockOffset {
    /// Seconds by which the log's clock is ahead of ours.
    pub fn offset_s(&self) -> f64 {
        self.offset_s
    }

    /// Follows the clock within `limit_s`. Gives whether it moved: claims compared with where their users were by another
    /// clock say nothing.
    pub fn follow(&mut self, limit_s: f64) -> bool {
        let offset_s = common_offset_s(self.users.values(), limit_s);
        let has_moved = (offset_s - self.offset_s).abs() > STEP_S;
        if has_moved {
            self.offset_s = offset_s;
        }
        has_moved
    }

    /// Takes each new claim whose beam stands clear of others. Users who are not where they say are no clock.
    pub fn update(&mut self, frame: &FrameContext, is_mismatched: impl Fn(&str) -> bool) {
        for (i, claim) in frame.claims.iter().enumerate() {
            let Some(track) = frame.track(i).filter(|t| t.confirmed && !claim.ended) else {
                continue;
            };
            let user = self.users.entry(&claim.claim.user);
            let time = claim.claim.time;
            if user.newest.is_some_and(|newest| newest >= time) {
                continue;
            }
            user.newest = Some(time);
            let is_clear = track.merged_into.is_none() && frame.confusion_m(track) == 0.0;
            if let Some(stamped) = track.at(time)
                && is_clear
                && !is_mismatched(&claim.claim.user)
            {
                let claimed = claim.claimed + frame.displacement_at(claim.claimed);
                user.push(stamped - claimed, track.filter.velocity(), claim.variance);
            }
        }
    }

    pub fn retain(&mut self, is_kept: impl Fn(&str) -> bool) {
        self.users.retain(is_kept);
    }
}

impl UserClock {
    /// Takes a claim of variance `variance` per axis, m², that lies `offset` from where its beam, at `velocity`, was at the
    /// claim's time.
    fn push(&mut self, offset: Vector2<f64>, velocity: Vector2<f64>, variance: f64) {
        let keep = 1.0 - 1.0 / MEMORY;
        let weight = 1.0 / (variance + BEAM_VARIANCE);
        self.information = keep * self.information + weight * velocity.norm_squared();
        self.offset = keep * self.offset + weight * offset.dot(&velocity);
        self.claims = keep * self.claims + 1.0;
    }

    /// Seconds by which the clock is ahead of ours, where this user moved enough to show it.
    fn offset_s(&self) -> Option<f64> {
        // The common share of the claims' errors does not average out.
        let variance = (1.0 + COMMON_SHARE * self.claims) / self.information;
        (variance < RESOLUTION_S * RESOLUTION_S).then(|| self.offset / self.information)
    }
}

/// The median over those who move, within `limit_s`; zero where it does not stand out. Fewer than half of the movers cannot shift
/// it, and whoever does gains `limit_s` of each user's own way and no more.
fn common_offset_s<'a>(users: impl Iterator<Item = &'a UserClock>, limit_s: f64) -> f64 {
    let offsets: Vec<f64> = users.filter_map(UserClock::offset_s).collect();
    if offsets.len() < MIN_MOVERS {
        return 0.0;
    }
    match median(offsets.into_iter()) {
        Some(offset) if offset.abs() >= RESOLUTION_S => offset.clamp(-limit_s, limit_s),
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mover(offset_s: f64, speed: f64) -> UserClock {
        let mut user = UserClock::default();
        for k in 0..30 {
            let (sin, cos) = f64::from(k).sin_cos();
            let v = Vector2::new(speed * cos, speed * sin);
            user.push(v * offset_s, v, 0.09);
        }
        user
    }

    fn common(users: &[UserClock], limit_s: f64) -> f64 {
        common_offset_s(users.iter(), limit_s)
    }

    #[test]
    fn movers_show_what_the_clock_is_off() {
        let users: Vec<_> = (0..4).map(|_| mover(0.8, 5.0)).collect();
        assert!((common(&users, 1.0) - 0.8).abs() < 1e-9);
        assert_eq!(common(&users, 0.5), 0.5);
        assert_eq!(common(&users[..2], 1.0), 0.0);
    }

    #[test]
    fn neither_those_who_stand_nor_a_few_liars_move_the_clock() {
        let slow: Vec<_> = (0..9).map(|_| mover(0.8, 0.2)).collect();
        assert_eq!(common(&slow, 1.0), 0.0);
        let mut users: Vec<_> = (0..5).map(|_| mover(0.0, 5.0)).collect();
        users.extend((0..4).map(|_| mover(1.0, 5.0)));
        assert_eq!(common(&users, 1.0), 0.0);
    }

    #[test]
    fn a_small_change_is_not_followed() {
        let mut clock = ClockOffset {
            offset_s: 0.75,
            ..ClockOffset::default()
        };
        for user in ["u-0", "u-1", "u-2"] {
            *clock.users.entry(user) = mover(0.8, 5.0);
        }
        assert!(!clock.follow(1.0));
        assert_eq!(clock.offset_s(), 0.75);
        clock.offset_s = 0.0;
        assert!(clock.follow(1.0));
        assert!((clock.offset_s() - 0.8).abs() < 1e-9);
        clock.retain(|user| user == "u-0");
        assert!(clock.follow(1.0), "one mover shows nothing");
        assert_eq!(clock.offset_s(), 0.0);
    }
}
