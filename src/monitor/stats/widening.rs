//! The direction of a second beam within a spot, by the spot's second moments.

use std::sync::LazyLock;

use nalgebra::{Matrix3, Vector3};

/// Moments of a second beam in the directions that are tried, over half a turn. The best of sixteen is at most 6° off, which costs
/// less than 2 % of the statistic.
static DIRECTIONS: LazyLock<[Vector3<f64>; 16]> = LazyLock::new(|| {
    std::array::from_fn(|k| {
        let (y, x) = (std::f64::consts::PI * k as f64 / 16.0).sin_cos();
        Vector3::new(x * x, x * y, y * y)
    })
});

/// Trace of the moments beyond what is expected, σ², and −ln p of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Widening {
    pub trace: f64,
    pub neg_log_p: f64,
}

/// The moments of a second beam in the direction that explains `off` best. Whitened, the directions are the edge of a convex
/// cone: a closed convex curve on the unit sphere, at most 2π long. The largest of them exceeds u with a probability of at
/// most Q(u) + e^(−u²/2) (Rice, 1945, for the upcrossings), below 1.5·e^(−u²/2).
pub fn widening(off: Vector3<f64>, inverse: Matrix3<f64>) -> Widening {
    let mut best = Widening::default();
    let along = inverse * off;
    for v in DIRECTIONS.iter() {
        let (slope, curvature) = (v.dot(&along), v.dot(&(inverse * v)));
        let neg_log_p = 0.5 * slope * slope / curvature - 1.5f64.ln();
        if slope > 0.0 && neg_log_p > best.neg_log_p {
            best = Widening {
                trace: slope / curvature,
                neg_log_p,
            };
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_direction_of_a_second_beam_by_hand() {
        // Along x, three standard deviations out: 3²/2 − ln 1.5.
        let found = widening(Vector3::new(0.3, 0.0, 0.0), Matrix3::identity() * 100.0);
        assert!((found.neg_log_p - (4.5 - 1.5f64.ln())).abs() < 1e-12 && (found.trace - 0.3).abs() < 1e-12);
        // Narrower than one spot is no second beam.
        let narrower = widening(Vector3::new(-0.3, 0.0, -0.3), Matrix3::identity() * 100.0);
        assert_eq!(narrower, Widening::default());
    }
}
