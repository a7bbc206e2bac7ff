//! How fast the displacement that all users share changes. A mount's tilt, a heading and a receiver's offset last; a position that
//! somebody drags away does not, however large an error the poses' source states.

use std::collections::VecDeque;

use nalgebra::{Matrix6, SMatrix, Vector2};

use super::bias::{STATE, SharedOffset, State};
use crate::monitor::stats::claim_consistency::share_after_averaging;

/// Time within which a change counts, s. Longer finds a slower drag, and takes a heading's or a receiver's own wander for one.
pub const MEMORY_S: f64 = 10.0;
/// What was is the mean of this long before and after that, s. Longer is more exact, and contains a drag earlier.
const AROUND_S: f64 = 4.0;
/// Time over which the newest claims are averaged, s. Longer is more exact, shorter finds a drag sooner.
const NEWEST_S: f64 = 2.0;
/// Time between two that are kept, s: claims come once a second.
const STEP_S: f64 = 0.5;
/// Time after which it is learned how far the displacement wanders, s: most of the delay and of what lasts is known then.
const LEARNED_S: f64 = 20.0;
/// Time over which it is learned how far the displacement wanders, s. Longer is more exact, shorter follows a wind that rises.
const WANDER_S: f64 = 60.0;
/// Time in which a lasting error and the delay of the poses are learned, s: three times that over which claims are averaged.
const SETTLES_S: f64 = 30.0;

/// The displacement of the newest frames against that ten seconds before.
#[derive(Clone, Debug, Default)]
pub struct PoseWander {
    newest: Mean,
    /// Of the newest, per axis, m².
    variance: f64,
    /// What the newest was, and when.
    earlier: VecDeque<(f64, Mean)>,
    /// Mean square, per axis, of what the lasting error leaves of the newest, less the claims' own and that of the tracks' course, m².
    wandered: f64,
    known_s: f64,
    unknown_s: f64,
}

/// A mean of what users share.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    left: Vector2<f64>,
    state: State,
    by_state: SMatrix<f64, 2, STATE>,
    /// Variance per axis that tracks' common course explains, m².
    by_course: f64,
}

impl Mean {
    fn follow(&mut self, next: &Self, gain: f64) {
        self.left += (next.left - self.left) * gain;
        self.state += (next.state - self.state) * gain;
        self.by_state += (next.by_state - self.by_state) * gain;
        self.by_course += (next.by_course - self.by_course) * gain;
    }
}

impl PoseWander {
    /// Takes the displacement that users share in a frame, `dt` seconds after the one before; each claims every `period_s`. None where
    /// they cannot tell: after that for longer than the memory it begins anew. `course` is the covariance of the tracks' common course.
    pub fn update(&mut self, shared: Option<SharedOffset>, course: &Matrix6<f64>, dt: f64, period_s: f64) {
        let Some(SharedOffset {
            left,
            state,
            by_state,
            variance,
        }) = shared
        else {
            self.unknown_s += dt;
            if self.unknown_s > MEMORY_S {
                *self = Self::default();
            }
            return;
        };
        self.unknown_s = 0.0;
        self.known_s += dt;
        let gain = (dt / self.known_s.min(NEWEST_S)).min(1.0);
        // The tracks' course is in the world, as the state's first part.
        let by_pose = by_state.fixed_columns::<6>(0);
        let seen = Mean {
            left,
            state,
            by_state,
            by_course: 0.5 * (by_pose * course * by_pose.transpose()).trace(),
        };
        self.newest.follow(&seen, gain);
        self.variance = variance * share_after_averaging(NEWEST_S, period_s);
        let now = self.known_s;
        if self.earlier.back().is_none_or(|(at, _)| now - at >= STEP_S) {
            self.earlier.push_back((now, self.newest));
        }
        while let Some((at, was)) = self.earlier.front().filter(|(at, _)| now - at > MEMORY_S + AROUND_S) {
            if *at > LEARNED_S {
                let wandered = 0.5 * was.left.norm_squared() - self.variance - was.by_course;
                self.wandered += (wandered - self.wandered) * (STEP_S / (at - LEARNED_S).min(WANDER_S)).min(1.0);
            }
            self.earlier.pop_front();
        }
    }

    /// By how much the displacement has changed, m; nothing before it has settled. It is another at other places though nothing changes, and
    /// where users were its error may not show: what has changed is less where they are or where they were, whichever it is.
    pub fn change(&self) -> Vector2<f64> {
        let before = self.known_s - (MEMORY_S - AROUND_S);
        let earlier = self.earlier.iter().filter(|(at, _)| *at < before);
        let mut was = Mean::default();
        let mut count = 0.0;
        for (_, mean) in earlier {
            count += 1.0;
            was.follow(mean, 1.0 / count);
        }
        if count == 0.0 || self.known_s < SETTLES_S {
            return Vector2::zeros();
        }
        let (left, state) = (self.newest.left - was.left, self.newest.state - was.state);
        let [here, there] = [self.newest.by_state, was.by_state].map(|by_state| left + by_state * state);
        if here.norm() < there.norm() { here } else { there }
    }

    /// Variance per axis, m², by which the displacement wandered about the lasting error's before what may be a drag.
    pub fn wandered(&self) -> f64 {
        self.wandered.max(0.0)
    }

    /// For how long that has been seen, s.
    pub fn seen_s(&self) -> f64 {
        (self.known_s - LEARNED_S - MEMORY_S - AROUND_S).max(0.0)
    }

    /// Of the change, per axis, m². That of the mean before is less than what claims near in time share, which cancels.
    pub fn variance(&self) -> f64 {
        self.variance
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl PoseWander {
        /// Takes a tenth of a second, tracks that go straight, and claims once a second.
        fn see(&mut self, shared: Option<SharedOffset>) {
            self.update(shared, &Matrix6::zeros(), 0.1, 1.0);
        }
    }

    #[test]
    fn a_drag_is_a_change_and_a_lasting_error_is_none() {
        let shared = |x: f64| {
            Some(SharedOffset {
                left: Vector2::new(x, 0.0),
                variance: 0.03,
                ..SharedOffset::default()
            })
        };
        let mut wander = PoseWander::default();
        // Before the first frame no time has passed.
        wander.update(shared(0.0), &Matrix6::zeros(), 0.0, 1.0);
        let mut push = |x: f64, seconds: usize, speed: f64| {
            let mut at = x;
            for _ in 0..10 * seconds {
                at += 0.1 * speed;
                wander.see(shared(at));
            }
            wander.change().x
        };
        // An error of eight metres, found within ten seconds, then nothing that changes.
        assert_eq!(push(0.0, 10, 0.8), 0.0);
        assert!(push(8.0, 60, 0.0).abs() < 0.1);
        // 1 m/s: as many metres as seconds, less the two over which the newest are averaged.
        assert!((push(8.0, 6, 1.0) - 4.1).abs() < 0.1);
        (0..50).for_each(|_| wander.see(None));
        assert!(wander.change().x > 4.0);
        (0..60).for_each(|_| wander.see(None));
        assert_eq!(wander.change(), Vector2::zeros());
    }

    #[test]
    fn what_comes_and_goes_is_a_wander_and_what_claims_scatter_by_is_none() {
        let by_state = SMatrix::from_fn(|row, column| f64::from(u8::from(column == 3 + row)));
        let swing = |amplitude: f64, course: f64| {
            let mut wander = PoseWander::default();
            for k in 0..1800 {
                let x = amplitude * (std::f64::consts::TAU * f64::from(k) / 300.0).sin();
                let shared = SharedOffset {
                    left: Vector2::new(x, 0.0),
                    variance: 0.03,
                    by_state,
                    ..SharedOffset::default()
                };
                wander.update(Some(shared), &(Matrix6::identity() * course), 0.1, 1.0);
            }
            wander.wandered()
        };
        // A quarter of the amplitude's square per axis, a little less as the newest two seconds are averaged.
        let found = swing(2.0, 0.0);
        assert!((0.8..1.0).contains(&found), "{found}");
        assert_eq!(swing(0.1, 0.0), 0.0);
        // What the tracks' common course explains is stated already.
        assert!((found - swing(2.0, 0.5) - 0.5).abs() < 1e-9);
    }

    #[test]
    fn users_who_go_elsewhere_change_nothing() {
        // A heading that is off by 3 degrees displaces a user at 100 m by 5 m, to another side on each side.
        let mut state = State::zeros();
        state[2] = 0.05;
        let seen_at = |x: f64, state: State| SharedOffset {
            state,
            by_state: SMatrix::from_fn(|row, column| if (row, column) == (1, 2) { -x } else { 0.0 }),
            variance: 0.03,
            ..SharedOffset::default()
        };
        let mut wander = PoseWander::default();
        for k in 0..900 {
            let x = 100.0 * (0.03 * f64::from(k)).sin();
            wander.see(Some(seen_at(x, state)));
            assert!(wander.change().norm() < 1e-9);
        }
        // One that turns by as much within five seconds does.
        (0..200).for_each(|_| wander.see(Some(seen_at(100.0, state))));
        (0..50).for_each(|_| wander.see(Some(seen_at(100.0, 2.0 * state))));
        assert!(wander.change().norm() > 1.0, "{}", wander.change());
    }
}
