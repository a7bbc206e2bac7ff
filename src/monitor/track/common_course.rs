//! How fast all tracks together follow the poses. What the beams of a frame share is taken out of it as a pose error, so that only
//! this tells the tracks where they are, and at what speed all of them move.

use nalgebra::{Matrix2x6, Matrix6, Vector2, Vector6};

use super::registration::Registration;

/// Longest and shortest time over which a straight line is fitted to the error that tracks and poses share, s. Longer lets a dragged
/// position be noticed later and tracks go astray with users who turn together, shorter has tracks follow a pose that is late to and fro and
/// what is wrong with single poses.
const MEMORY_S: f64 = 6.0;
const LEAST_MEMORY_S: f64 = 0.5;
/// Time between two errors that are compared, s: those of single poses have nothing to do with each other, those of turning users do.
/// Longer takes fast turns for noise, shorter the noise of poses that are interpolated for a turn. Not measured.
const APART_S: f64 = 0.5;
/// How far the delay of the poses may have them be off, m, for the errors that last to be the tracks'. Not measured.
const ON_TIME_M: f64 = 0.2;

/// Change of the delay of the poses, s, with which what tracks have followed is of another time: a sway of 8° in 8 s turns by 0.6 mrad
/// within it. Smaller has noise move the tracks, larger leaves them swinging.
const RETIMED_S: f64 = 6e-3;
/// What is left of the memory then, s. Longer swings on, shorter follows the noise of single poses.
const RETIMED_MEMORY_S: f64 = 2.0;

/// Time over which it is learned whether errors last, s. Longer is more exact, shorter follows users who begin to turn. Not measured.
const AVERAGED_S: f64 = 20.0;

/// How fast tracks go astray together while no pose tells, m/s per axis: users change their pace by more, but not all alike. Not measured
/// on users other than the simulator's.
const LOST_M_S: f64 = 0.2;
/// Time in which they are back once poses tell again, s: the first ones tell most. Not tuned.
const BACK_S: f64 = 1.5;

/// Time over which the newest errors' mean square is taken, s. Longer still states how tracks swung before the delay of the poses was
/// learned, shorter scatters.
const NEWEST_S: f64 = 3.0;

/// Variance of the mean of white errors over that of the same mean of what is left of them against tracks that follow it.
const FOLLOWED: f64 = 1.4;

/// A straight line through the shared error by least squares, over the time since the tracks began or the memory (an α-β filter;
/// Bar-Shalom, Li and Kirubarajan, 2001, section 6.5).
#[derive(Clone, Copy, Debug, Default)]
pub struct CommonCourse {
    seen_s: f64,
    delay_s: f64,
    /// How far the tracks have been moved since they began, and how fast that makes them move, as errors of the pose.
    moved: Vector6<f64>,
    velocity: Vector6<f64>,
    /// The mean of the errors that are newest, the mean of its square, and what of that the tracks' own errors do not explain.
    newest: Vector6<f64>,
    newest_square: Matrix6<f64>,
    cov: Matrix6<f64>,
    /// How far tracks may have gone astray without poses, m per axis.
    lost_m: f64,
    averaged_s: f64,
    /// Since when the poses are on time, s.
    on_time_s: f64,
    lasting: Lasting,
}

/// Whether errors last.
#[derive(Clone, Copy, Debug, Default)]
struct Lasting {
    /// That of a moment ago, m, and how long ago, s.
    earlier: Vector2<f64>,
    since_s: f64,
    /// Mean squares of errors and of half their changes, m².
    square: f64,
    change: f64,
}

impl Lasting {
    /// Takes a frame's error, m, `dt` seconds after the last one's, into means over `over_s`.
    fn take(&mut self, error: Vector2<f64>, dt: f64, over_s: f64) {
        self.since_s += dt;
        if self.since_s >= APART_S {
            let share = (self.since_s / over_s.max(self.since_s)).min(1.0);
            self.square += (error.norm_squared() - self.square) * share;
            self.change += (0.5 * (error - self.earlier).norm_squared() - self.change) * share;
            (self.earlier, self.since_s) = (error, 0.0);
        }
    }

    /// 1 where errors have nothing to do with those a moment before, 0 where they are the same.
    fn share_of_single(&self) -> f64 {
        if self.change < self.square {
            self.change / self.square
        } else {
            1.0
        }
    }
}

/// Shares of a frame's error that go into all tracks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pull {
    /// Into their positions, 0 to 1.
    pub position: f64,
    /// Into their velocities, 1/s.
    pub velocity: f64,
}

impl Pull {
    /// Share of the newest error in an exponential mean whose variance is that of a position that is pulled so every `dt` seconds, if errors
    /// have nothing to do with each other (Bar-Shalom, Li and Kirubarajan, 2001, section 6.5). Errors that last, as of users who turn
    /// together, are in that mean as they are in the position.
    fn share_of_newest(&self, dt: f64) -> f64 {
        let (a, b) = (self.position, self.velocity * dt);
        let ratio = (2.0 * a * a + b * (2.0 - 3.0 * a)) / (a * (4.0 - 2.0 * a - b));
        2.0 * ratio / (1.0 + ratio)
    }
}

impl CommonCourse {
    /// The tracks are new.
    pub fn restart(&mut self) {
        *self = Self::default();
    }

    /// The poses are taken `delay_s` late, and are `off_m` off as that is not known exactly. Where it has been learned meanwhile, tracks
    /// have followed a platform that swayed otherwise.
    pub fn take_delay(&mut self, delay_s: f64, off_m: f64) {
        if off_m > ON_TIME_M {
            self.on_time_s = 0.0;
        }
        if (delay_s - self.delay_s).abs() > RETIMED_S {
            self.delay_s = delay_s;
            self.seen_s = self.seen_s.min(RETIMED_MEMORY_S);
        }
    }

    /// The error of a frame's pose against where the tracks began, `found` being that against the tracks, which take `pull` of it;
    /// `by_pose`: how the pose moves the place below.
    pub fn take(&mut self, found: &Registration, by_pose: &Matrix2x6<f64>, pull: Pull, dt: f64) -> Vector6<f64> {
        let Registration { error, cov: own } = found;
        self.lasting.take(by_pose * error, dt, self.averaged_s);
        self.moved += self.velocity * dt;
        let since_began = error + self.moved;
        self.moved += error * pull.position;
        self.velocity += error * pull.velocity;
        if pull.position > 0.0 {
            self.averaged_s = (self.averaged_s + dt).min(AVERAGED_S);
            let of_mean = (dt / self.averaged_s.min(NEWEST_S)).min(1.0);
            self.newest += (error - self.newest) * pull.share_of_newest(dt);
            self.newest_square += (self.newest * self.newest.transpose() - self.newest_square) * of_mean;
            let below = |cov: &Matrix6<f64>| (by_pose * cov * by_pose.transpose()).trace();
            let (all, own) = (below(&self.newest_square), below(own));
            self.cov = match own < all {
                true => self.newest_square * (FOLLOWED * (1.0 - own / all)),
                false => Matrix6::zeros(),
            };
        }
        since_began
    }

    /// Covariance of the end of the line: what the errors of single poses, and users who turn together, leave in all tracks, and what
    /// they went astray without poses.
    pub fn cov(&self) -> Matrix6<f64> {
        let lost = self.lost_m * self.lost_m;
        self.cov + Matrix6::from_diagonal(&[0.0, 0.0, 0.0, lost, lost, 0.0].into())
    }

    /// No pose tells of `dt` seconds.
    pub fn lose(&mut self, dt: f64) {
        self.lost_m += LOST_M_S * dt;
    }

    /// How long errors are averaged: as long as it is single poses that make them. What lasts is the tracks' own, as users turn together.
    fn memory_s(&self) -> f64 {
        if self.on_time_s < MEMORY_S {
            return MEMORY_S;
        }
        (MEMORY_S * self.lasting.share_of_single()).max(LEAST_MEMORY_S)
    }

    /// The pull of a frame that comes `dt` seconds after the last one.
    pub fn pull(&mut self, dt: f64) -> Pull {
        if !(dt > 0.0) {
            return Pull::default();
        }
        self.on_time_s += dt;
        self.lost_m *= (-dt / BACK_S).exp();
        self.seen_s = (self.seen_s + dt).min(self.memory_s());
        let n = (self.seen_s / dt).max(1.0);
        let of_both = 2.0 / ((n + 1.0) * (n + 2.0));
        Pull {
            position: ((2.0 * n + 1.0) * of_both).min(1.0),
            velocity: 3.0 * of_both / dt,
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    impl CommonCourse {
        /// Takes an error of the place, m.
        fn take_shift(&mut self, x: f64, pull: Pull, dt: f64) -> Vector6<f64> {
            let found = Registration {
                error: Vector6::new(0.0, 0.0, 0.0, x, 0.0, 0.0),
                cov: Matrix6::zeros(),
            };
            let by_pose = Matrix2x6::from_fn(|row, column| f64::from(u8::from(column == 3 + row)));
            self.take(&found, &by_pose, pull, dt)
        }
    }

    /// The largest error after half a minute of a common course of tracks that began with 1 m/s too much and move at `turning(t)` m/s, where
    /// poses are `late(t)` off and their delay may have them be `off_m` off.
    fn left(late: impl Fn(f64) -> f64, turning: impl Fn(f64) -> f64, off_m: f64) -> f64 {
        let mut course = CommonCourse::default();
        let (mut x, mut v, mut largest) = (0.0, 1.0, 0.0f64);
        for k in 0..600 {
            let (dt, t) = (0.1, 0.1 * f64::from(k));
            x += (v + turning(t)) * dt;
            course.take_delay(0.0, off_m);
            let error = late(t) - x;
            let pull = course.pull(dt);
            let since_began = course.take_shift(error, pull, dt);
            if turning(t) == 0.0 {
                // All but the velocity that the tracks began with.
                assert!((since_began[3] - (late(t) - (t + dt))).abs() < 1e-9);
            }
            x += pull.position * error;
            v += pull.velocity * error;
            if k >= 300 {
                largest = largest.max(x.abs());
            }
        }
        largest
    }

    #[test]
    fn tracks_go_astray_without_poses_and_come_back_with_them() {
        let mut course = CommonCourse::default();
        (0..40).for_each(|_| course.lose(0.1));
        // 0.2 m/s for four seconds.
        assert!((course.cov()[(3, 3)] - 0.64).abs() < 1e-9 && course.cov()[(0, 0)] == 0.0);
        (0..15).for_each(|_| _ = course.pull(0.1));
        assert!((course.cov()[(4, 4)] - 0.64 * (-2.0f64).exp()).abs() < 1e-6);
    }

    #[test]
    fn the_noise_of_poses_is_in_the_tracks_as_stated() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut course = CommonCourse::default();
        let (mut x, mut v, mut squares, mut stated) = (0.0, 0.0, 0.0, 0.0);
        for k in 0..100_000 {
            x += v * 0.1;
            let noise: f64 = StandardNormal.sample(&mut rng);
            let error = 0.15 * noise - x;
            let pull = course.pull(0.1);
            course.take_shift(error, pull, 0.1);
            x += pull.position * error;
            v += pull.velocity * error;
            if k > 100 {
                squares += x * x;
                stated += course.cov()[(3, 3)];
            }
        }
        assert!((squares / stated - 1.0).abs() < 0.1, "{}", squares / stated);
    }

    #[test]
    fn a_delay_that_has_been_learned_shortens_the_memory() {
        let pull = |delays: [f64; 2]| {
            let mut course = CommonCourse::default();
            for k in 0..100 {
                course.take_delay(delays[k / 99], 0.0);
                course.pull(0.1);
            }
            course.pull(0.1).position
        };
        assert_eq!(pull([0.02, 0.02]), pull([0.02, 0.021]));
        assert!(pull([0.0, 0.03]) > 2.0 * pull([0.03, 0.03]));
    }

    #[test]
    fn tracks_lose_a_common_velocity_and_do_not_swing() {
        for off_m in [0.0, 1.0] {
            let lost = left(|_| 0.0, |_| 0.0, off_m);
            assert!(lost < 1e-3, "{lost}");
        }
        // A sway of 8 s that is seen 1 m off: less of it in the tracks.
        let swayed = left(|t| (0.785 * t).sin(), |_| 0.0, 1.0);
        assert!(swayed < 0.8, "{swayed}");
    }

    #[test]
    fn users_who_turn_together_do_not_take_the_tracks_with_them() {
        let [on_time, late] = [0.0, 1.0].map(|off_m| left(|_| 0.0, |t| 0.5 * (0.8 * t).cos(), off_m));
        assert!(on_time < 0.5 * late, "{on_time} and {late}");
    }
}
