//! A shift, turn and scale of the ground, and the claims that it is estimated from.

use nalgebra::Vector2;

/// A claim and how far from it an honest user's beam may be found now, m.
#[derive(Clone, Copy, Debug)]
pub struct Witness {
    pub claimed: Vector2<f64>,
    pub variance: f64,
    pub reach_m: f64,
}

/// A shift, and a turn about the nadir with a scale: an error in tilt, in heading, in altitude. A position p appears at
/// `p + shift + A·p`, `A = [[scale, −turn], [turn, scale]]`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Displacement {
    pub shift: Vector2<f64>,
    /// Relative error of scale.
    pub scale: f64,
    /// Counter-clockwise, rad.
    pub turn: f64,
}

impl Displacement {
    pub fn at(&self, p: Vector2<f64>) -> Vector2<f64> {
        self.shift + Vector2::new(self.scale * p.x - self.turn * p.y, self.turn * p.x + self.scale * p.y)
    }
}
