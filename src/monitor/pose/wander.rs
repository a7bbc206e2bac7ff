//! How fast the displacement that all users share changes. A mount's tilt, a heading and a receiver's offset last; a position that
//! somebody drags away does not, however large an error the poses' source states.

use nalgebra::Vector2;

/// Time within which a change counts, s. Longer finds a slower drag, and takes a heading's or a receiver's own wander for one.
pub const MEMORY_S: f64 = 10.0;
/// Time in which a lasting error and the delay of the poses are learned, s: three times that over which claims are averaged.
const SETTLES_S: f64 = 30.0;

/// The displacement of the newest frames against that of the seconds before.
#[derive(Clone, Debug, Default)]
pub struct PoseWander {
    mean: Vector2<f64>,
    newest: Vector2<f64>,
    known_s: f64,
    unknown_s: f64,
}

impl PoseWander {
    /// Takes the displacement of a frame, m, `dt` seconds after the one before; none where users cannot tell. After that for longer
    /// than the memory it begins anew.
    pub fn update(&mut self, displacement: Option<Vector2<f64>>, dt: f64) {
        let Some(displacement) = displacement else {
            self.unknown_s += dt;
            if self.unknown_s > MEMORY_S {
                *self = Self::default();
            }
            return;
        };
        self.unknown_s = 0.0;
        self.known_s += dt;
        self.newest = displacement;
        let share = match self.known_s > dt {
            true => dt / self.known_s.min(MEMORY_S),
            false => 1.0,
        };
        self.mean += (displacement - self.mean) * share;
    }

    /// By how much the displacement has changed, m; nothing before it has settled.
    pub fn change(&self) -> Vector2<f64> {
        match self.known_s > SETTLES_S {
            true => self.newest - self.mean,
            false => Vector2::zeros(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drag_is_a_change_and_a_lasting_error_is_none() {
        let mut wander = PoseWander::default();
        let mut push = |x: f64, seconds: usize, speed: f64| {
            let mut at = x;
            for _ in 0..10 * seconds {
                at += 0.1 * speed;
                wander.update(Some(Vector2::new(at, 0.0)), 0.1);
            }
            wander.change().x
        };
        // An error of eight metres, found within ten seconds, then nothing that changes.
        assert_eq!(push(0.0, 10, 0.8), 0.0);
        assert!(push(8.0, 60, 0.0).abs() < 0.1);
        // 1 m/s: 10·(1 − e⁻ᵗᐟ¹⁰) metres after t seconds.
        assert!((push(8.0, 10, 1.0) - 6.3).abs() < 0.1);
        (0..50).for_each(|_| wander.update(None, 0.1));
        assert!(wander.change().x > 6.0);
        (0..60).for_each(|_| wander.update(None, 0.1));
        assert_eq!(wander.change(), Vector2::zeros());
    }
}
