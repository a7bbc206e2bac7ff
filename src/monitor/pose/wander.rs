//! How fast the displacement that all users share changes. A mount's tilt, a heading and a receiver's offset last; a position that
//! somebody drags away does not, however large an error the poses' source states.

use std::collections::VecDeque;

use nalgebra::Vector2;

use super::bias::SharedOffset;
use crate::monitor::stats::claim_consistency::share_after_averaging;

/// Time within which a change counts, s. Longer finds a slower drag, and takes a heading's or a receiver's own wander for one.
pub const MEMORY_S: f64 = 10.0;
/// What was is the mean of this long before and after that, s. Longer is more exact, and contains a drag earlier.
const AROUND_S: f64 = 4.0;
/// Time over which the newest claims are averaged, s. Longer is more exact, shorter finds a drag sooner.
const NEWEST_S: f64 = 2.0;
/// Time between two that are kept, s: claims come once a second.
const STEP_S: f64 = 0.5;
/// Time in which a lasting error and the delay of the poses are learned, s: three times that over which claims are averaged.
const SETTLES_S: f64 = 30.0;

/// The displacement of the newest frames against that ten seconds before.
#[derive(Clone, Debug, Default)]
pub struct PoseWander {
    newest: Vector2<f64>,
    /// Of the newest, per axis, m².
    variance: f64,
    /// What the newest was, and when.
    earlier: VecDeque<(f64, Vector2<f64>)>,
    known_s: f64,
    unknown_s: f64,
}

impl PoseWander {
    /// Takes the displacement that users share in a frame, `dt` seconds after the one before; each claims every `period_s`. None where
    /// they cannot tell: after that for longer than the memory it begins anew.
    pub fn update(&mut self, shared: Option<SharedOffset>, dt: f64, period_s: f64) {
        let Some(SharedOffset { offset, variance }) = shared else {
            self.unknown_s += dt;
            if self.unknown_s > MEMORY_S {
                *self = Self::default();
            }
            return;
        };
        self.unknown_s = 0.0;
        self.known_s += dt;
        self.newest += (offset - self.newest) * (dt / self.known_s.min(NEWEST_S)).min(1.0);
        self.variance = variance * share_after_averaging(NEWEST_S, period_s);
        let now = self.known_s;
        if self.earlier.back().is_none_or(|(at, _)| now - at >= STEP_S) {
            self.earlier.push_back((now, self.newest));
        }
        while self
            .earlier
            .front()
            .is_some_and(|(at, _)| now - at > MEMORY_S + AROUND_S)
        {
            self.earlier.pop_front();
        }
    }

    /// By how much the displacement has changed, m; nothing before it has settled.
    pub fn change(&self) -> Vector2<f64> {
        let before = self.known_s - (MEMORY_S - AROUND_S);
        let earlier = || self.earlier.iter().filter(|(at, _)| *at < before);
        match earlier().count() {
            0 => Vector2::zeros(),
            _ if self.known_s < SETTLES_S => Vector2::zeros(),
            n => self.newest - earlier().map(|(_, offset)| offset).sum::<Vector2<f64>>() / n as f64,
        }
    }

    /// Of the change, per axis, m². That of the mean before is less than what claims near in time share, which cancels.
    pub fn variance(&self) -> f64 {
        self.variance
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drag_is_a_change_and_a_lasting_error_is_none() {
        let shared = |x: f64| {
            Some(SharedOffset {
                offset: Vector2::new(x, 0.0),
                variance: 0.03,
            })
        };
        let mut wander = PoseWander::default();
        // Before the first frame no time has passed.
        wander.update(shared(0.0), 0.0, 1.0);
        let mut push = |x: f64, seconds: usize, speed: f64| {
            let mut at = x;
            for _ in 0..10 * seconds {
                at += 0.1 * speed;
                wander.update(shared(at), 0.1, 1.0);
            }
            wander.change().x
        };
        // An error of eight metres, found within ten seconds, then nothing that changes.
        assert_eq!(push(0.0, 10, 0.8), 0.0);
        assert!(push(8.0, 60, 0.0).abs() < 0.1);
        // 1 m/s: as many metres as seconds, less the two over which the newest are averaged.
        assert!((push(8.0, 6, 1.0) - 4.1).abs() < 0.1);
        (0..50).for_each(|_| wander.update(None, 0.1, 1.0));
        assert!(wander.change().x > 4.0);
        (0..60).for_each(|_| wander.update(None, 0.1, 1.0));
        assert_eq!(wander.change(), Vector2::zeros());
    }
}
