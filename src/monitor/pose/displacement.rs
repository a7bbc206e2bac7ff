//! A shift, turn and scale of the ground.

use nalgebra::Vector2;

/// A shift, and a turn about the nadir with a scale: an error in tilt, in heading, in altitude. A position p appears at
/// `p + shift + A·p`, `A = [[scale, −turn], [turn, scale]]`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Displacement {
    /// m.
    pub shift: Vector2<f64>,
    /// Relative error of scale.
    pub scale: f64,
    /// Counter-clockwise, rad.
    pub turn: f64,
}

impl Displacement {
    pub fn of_shift(shift: Vector2<f64>) -> Self {
        Self {
            shift,
            ..Self::default()
        }
    }

    /// The displacement of a place, m.
    pub fn at(&self, p: Vector2<f64>) -> Vector2<f64> {
        self.shift + Vector2::new(self.scale * p.x - self.turn * p.y, self.turn * p.x + self.scale * p.y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_and_a_scale_about_the_nadir() {
        let turned = Displacement {
            shift: Vector2::new(1.0, 0.0),
            scale: 0.1,
            turn: 0.01,
        };
        assert!((turned.at(Vector2::new(10.0, 0.0)) - Vector2::new(2.0, 0.1)).norm() < 1e-12);
        assert!((turned.at(Vector2::new(0.0, 10.0)) - Vector2::new(0.9, 1.0)).norm() < 1e-12);
    }
}
