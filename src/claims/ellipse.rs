//! Uncertainty shapes as covariances.

use nalgebra::{Matrix2, Vector2};

/// A shape that is said to hold the place for certain holds it with this probability: a Gaussian has no such shape.
const MOST_CONFIDENCE: f64 = 0.999;

/// Covariance, m², of a place within an ellipse of these half-axes, m, with this probability. `bearing_deg` is the direction of the longer axis
/// clockwise from +y. The squared Mahalanobis distance of a plane Gaussian exceeds k² with probability exp(−k²/2).
pub(super) fn covariance(half_axes_m: [f64; 2], bearing_deg: f64, confidence: f64) -> [[f64; 2]; 2] {
    let k2 = -2.0 * (1.0 - confidence.min(MOST_CONFIDENCE)).ln();
    let (sin, cos) = bearing_deg.to_radians().sin_cos();
    let (along, across) = (Vector2::new(sin, cos), Vector2::new(cos, -sin));
    let [a2, b2] = half_axes_m.map(|m| m * m / k2);
    let cov: Matrix2<f64> = a2 * along * along.transpose() + b2 * across * across.transpose();
    [[cov[(0, 0)], cov[(0, 1)]], [cov[(0, 1)], cov[(1, 1)]]]
}

/// A covariance that was stated: symmetric, finite and not negative.
pub(super) fn checked_cov(cov: [[f64; 2]; 2]) -> Option<[[f64; 2]; 2]> {
    let [[a, b], [c, d]] = cov;
    let is_finite = [a, b, c, d].iter().all(|v| v.is_finite());
    let is_symmetric = (b - c).abs() <= 1e-6 * (a.abs() + d.abs());
    (is_finite && is_symmetric && a >= 0.0 && d >= 0.0 && a * d - b * c >= -1e-9 * a * d).then_some([[a, b], [b, d]])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ellipse_is_a_covariance_along_its_axes() {
        // 39.35 % of a plane Gaussian lie within one standard deviation.
        let one_sigma = 1.0 - (-0.5f64).exp();
        let cov = covariance([10.0, 5.0], 0.0, one_sigma);
        assert!((cov[0][0] - 25.0).abs() < 1e-9 && (cov[1][1] - 100.0).abs() < 1e-9 && cov[0][1].abs() < 1e-9);
        // North-east: x and y together.
        let cov = covariance([10.0, 5.0], 45.0, one_sigma);
        assert!((cov[0][0] - 62.5).abs() < 1e-9 && (cov[0][1] - 37.5).abs() < 1e-9);
        // 95 %: k² = 5.991.
        let cov = covariance([10.0, 10.0], 17.0, 0.95);
        assert!((cov[0][0] - 100.0 / 5.991_46).abs() < 1e-4 && cov[0][1].abs() < 1e-9);
        assert!(covariance([10.0, 10.0], 0.0, 1.0)[0][0] > 7.0);
    }

    #[test]
    fn a_covariance_is_symmetric_and_not_negative() {
        assert!(checked_cov([[4.0, 1.0], [1.0, 2.0]]).is_some());
        assert!(checked_cov([[4.0, 1.0], [0.0, 2.0]]).is_none());
        assert!(checked_cov([[4.0, 9.0], [9.0, 2.0]]).is_none());
        assert!(checked_cov([[-4.0, 0.0], [0.0, 2.0]]).is_none());
        assert!(checked_cov([[f64::NAN, 0.0], [0.0, 2.0]]).is_none());
    }
}
