//! How fast all tracks together follow the poses. What the beams of a frame share is taken out of it as a pose error, so that only
//! this tells the tracks where they are, and at what speed all of them move.

use nalgebra::Vector6;

/// Time over which a straight line is fitted to the error that tracks and poses share, s. Longer lets a dragged position be
/// noticed later, shorter has tracks follow a pose that is late to and fro.
const MEMORY_S: f64 = 6.0;

/// A straight line through the shared error by least squares, over the time since the tracks began or the memory (an α-β filter;
/// Bar-Shalom, Li and Kirubarajan, 2001, section 6.5).
#[derive(Clone, Copy, Debug, Default)]
pub struct CommonCourse {
    seen_s: f64,
    /// How far the tracks have been moved since they began, and how fast that makes them move, as errors of the pose.
    moved: Vector6<f64>,
    velocity: Vector6<f64>,
}

/// Shares of a frame's error that go into all tracks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pull {
    /// Into their positions, 0 to 1.
    pub position: f64,
    /// Into their velocities, 1/s.
    pub velocity: f64,
}

impl CommonCourse {
    /// The tracks are new.
    pub fn restart(&mut self) {
        *self = Self::default();
    }

    /// The error of a frame's pose against where the tracks began, `error` being that against the tracks, which take `pull` of it.
    pub fn take(&mut self, error: &Vector6<f64>, pull: Pull, dt: f64) -> Vector6<f64> {
        self.moved += self.velocity * dt;
        let since_began = error + self.moved;
        self.moved += error * pull.position;
        self.velocity += error * pull.velocity;
        since_began
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
    fn tracks_lose_a_common_velocity_and_do_not_swing() {
        assert!(left(|_| 0.0) < 1e-3, "{}", left(|_| 0.0));
        // A sway of 8 s that is seen 1 m off: less of it in the tracks.
        let swayed = left(|t| (0.785 * t).sin());
        assert!(swayed < 0.8, "{swayed}");
    }
}
