//! How fast all tracks together follow the poses. What the beams of a frame share is taken out of it as a pose error, so that only
//! this tells the tracks where they are, and at what speed all of them move.

use nalgebra::{Matrix6, Vector6};

/// Time over which a straight line is fitted to the error that tracks and poses share, s. Longer lets a dragged position be
/// noticed later, shorter has tracks follow a pose that is late to and fro.
const MEMORY_S: f64 = 6.0;

/// Change of the delay of the poses, s, with which what tracks have followed is of another time: a sway of 8° in 8 s turns by 0.6 mrad
/// within it. Smaller has noise move the tracks, larger leaves them swinging.
const RETIMED_S: f64 = 6e-3;
/// What is left of the memory then, s. Longer swings on, shorter follows the noise of single poses.
const RETIMED_MEMORY_S: f64 = 2.0;

/// A straight line through the shared error by least squares, over the time since the tracks began or the memory (an α-β filter;
/// Bar-Shalom, Li and Kirubarajan, 2001, section 6.5).
#[derive(Clone, Copy, Debug, Default)]
pub struct CommonCourse {
    seen_s: f64,
    delay_s: f64,
    /// How far the tracks have been moved since they began, and how fast that makes them move, as errors of the pose.
    moved: Vector6<f64>,
    velocity: Vector6<f64>,
    /// Mean product of the errors, and what of it is in the end of the line.
    scatter: Matrix6<f64>,
    cov: Matrix6<f64>,
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
    /// Variance of a position that is pulled so every `dt` seconds, over that of the errors that pull it (Bar-Shalom, Li and
    /// Kirubarajan, 2001, section 6.5).
    fn variance_ratio(&self, dt: f64) -> f64 {
        let (a, b) = (self.position, self.velocity * dt);
        (2.0 * a * a + b * (2.0 - 3.0 * a)) / (a * (4.0 - 2.0 * a - b))
    }
}

impl CommonCourse {
    /// The tracks are new.
    pub fn restart(&mut self) {
        *self = Self::default();
    }

    /// The poses are taken `delay_s` late: where that has been learned meanwhile, tracks have followed a platform that swayed otherwise.
    pub fn take_delay(&mut self, delay_s: f64) {
        if (delay_s - self.delay_s).abs() > RETIMED_S {
            self.delay_s = delay_s;
            self.seen_s = self.seen_s.min(RETIMED_MEMORY_S);
        }
    }

    /// The error of a frame's pose against where the tracks began, `error` being that against the tracks, which take `pull` of it.
    pub fn take(&mut self, error: &Vector6<f64>, pull: Pull, dt: f64) -> Vector6<f64> {
        self.moved += self.velocity * dt;
        let since_began = error + self.moved;
        self.moved += error * pull.position;
        self.velocity += error * pull.velocity;
        if pull.position > 0.0 {
            self.scatter += (error * error.transpose() - self.scatter) * (dt / self.seen_s).min(1.0);
            self.cov = self.scatter * pull.variance_ratio(dt);
        }
        since_began
    }

    /// Covariance of the end of the line: what the errors of single poses leave in all tracks.
    pub fn cov(&self) -> &Matrix6<f64> {
        &self.cov
    }

    /// The pull of a frame that comes `dt` seconds after the last one.
    pub fn pull(&mut self, dt: f64) -> Pull {
        if !(dt > 0.0) {
            return Pull::default();
        }
        self.seen_s = (self.seen_s + dt).min(MEMORY_S);
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

    /// The largest error after half a minute of a common course of tracks that began with 1 m/s too much, where poses are
    /// `late(t)` off.
    fn left(late: impl Fn(f64) -> f64) -> f64 {
        let mut course = CommonCourse::default();
        let (mut x, mut v, mut largest) = (0.0, 1.0, 0.0f64);
        for k in 0..600 {
            let (dt, t) = (0.1, 0.1 * f64::from(k));
            x += v * dt;
            let error = late(t) - x;
            let pull = course.pull(dt);
            let since_began = course.take(&Vector6::new(0.0, 0.0, 0.0, error, 0.0, 0.0), pull, dt);
            // All but the velocity that the tracks began with.
            assert!((since_began[3] - (late(t) - (t + dt))).abs() < 1e-9);
            x += pull.position * error;
            v += pull.velocity * error;
            if k >= 300 {
                largest = largest.max(x.abs());
            }
        }
        largest
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
            course.take(&Vector6::new(0.0, 0.0, 0.0, error, 0.0, 0.0), pull, 0.1);
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
                course.take_delay(delays[k / 99]);
                course.pull(0.1);
            }
            course.pull(0.1).position
        };
        assert_eq!(pull([0.02, 0.02]), pull([0.02, 0.021]));
        assert!(pull([0.0, 0.03]) > 2.0 * pull([0.03, 0.03]));
    }

    #[test]
    fn tracks_lose_a_common_velocity_and_do_not_swing() {
        assert!(left(|_| 0.0) < 1e-3, "{}", left(|_| 0.0));
        // A sway of 8 s that is seen 1 m off: less of it in the tracks.
        let swayed = left(|t| (0.785 * t).sin());
        assert!(swayed < 0.8, "{swayed}");
    }
}
