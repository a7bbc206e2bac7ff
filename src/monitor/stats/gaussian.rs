//! Two-dimensional normal errors: distances in standard deviations, and bounds on the chance of an offset.

use nalgebra::{Matrix2, Vector2};

/// rᵀ S⁻¹ r; infinite when S is singular.
pub fn mahalanobis2(r: Vector2<f64>, s: Matrix2<f64>) -> f64 {
    s.try_inverse()
        .map_or(f64::INFINITY, |inverse| (r.transpose() * inverse * r)[0])
}

/// The larger eigenvalue of a symmetric 2 × 2 matrix.
pub fn largest_eigenvalue(s: &Matrix2<f64>) -> f64 {
    let mean = 0.5 * (s[(0, 0)] + s[(1, 1)]);
    mean + (0.5 * (s[(0, 0)] - s[(1, 1)])).hypot(s[(0, 1)])
}

/// −ln p of an offset with covariance `cov`, m², whose mean is known to lie within `radius_m` of zero: if it does, a value
/// above s has a probability of at most e⁻ˢ.
///
/// The larger of two bounds. The distance from a convex set is no more than the distance from the true point in it, whose
/// square is χ² of two degrees: s = t²/2, t in standard deviations beyond the disc. And where the disc is wide against
/// the error, its edge is nearly straight: the worst mean lies on the edge, and averaging the one-sided tail Q over the
/// transverse error (Laplace's method) gives Q(t)/√(1 − t·σ/radius).
pub fn neg_log_p_outside(offset: Vector2<f64>, cov: &Matrix2<f64>, radius_m: f64) -> f64 {
    let sigma = largest_eigenvalue(cov).max(1e-12).sqrt();
    let t = (offset.norm() - radius_m).max(0.0) / sigma;
    let convex = 0.5 * t * t;
    // Far out Q underflows; there the general bound is enough.
    if !(1.0..=30.0).contains(&t) {
        return convex;
    }
    let curvature = 1.0 - t * sigma / radius_m;
    if curvature < 0.5 {
        return convex;
    }
    let tail = 0.5 * libm::erfc(t * std::f64::consts::FRAC_1_SQRT_2);
    convex.max(-tail.ln() + 0.5 * curvature.ln())
}

/// −ln p of the sum of k independent values, each with P(S > s) ≤ e⁻ˢ: P(ΣS > s) ≤ e⁻ˢ·Σ sʲ/j! over j < k (Erlang).
pub fn neg_log_p_of_sum(of: &[f64]) -> f64 {
    let sum: f64 = of.iter().sum();
    let (mut term, mut series) = (1.0, 0.0);
    for j in 1..=of.len() {
        series += term;
        term *= sum / j as f64;
    }
    sum - series.ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_count_in_standard_deviations() {
        let s = Matrix2::new(4.0, 0.0, 0.0, 1.0);
        assert_eq!(mahalanobis2(Vector2::new(2.0, 3.0), s), 10.0);
        assert_eq!(mahalanobis2(Vector2::new(1.0, 0.0), Matrix2::zeros()), f64::INFINITY);
    }

    #[test]
    fn the_largest_eigenvalue_is_the_variance_along_the_longer_axis() {
        assert_eq!(largest_eigenvalue(&Matrix2::new(4.0, 0.0, 0.0, 1.0)), 4.0);
        // (1, 1)/√2 is the axis of this one.
        assert_eq!(largest_eigenvalue(&Matrix2::new(2.0, 1.0, 1.0, 2.0)), 3.0);
    }

    #[test]
    fn an_offset_inside_is_no_evidence() {
        let cov = Matrix2::identity();
        assert_eq!(neg_log_p_outside(Vector2::new(3.0, 4.0), &cov, 5.0), 0.0);
        // Half a standard deviation outside: ½·½².
        assert_eq!(neg_log_p_outside(Vector2::new(5.5, 0.0), &cov, 5.0), 0.125);
    }

    /// P(|r| > radius + t·σ) for r ~ N((radius, 0), σ²) by the midpoint rule over the transverse error.
    fn exact(t: f64, sigma: f64, radius: f64) -> f64 {
        let reach = radius + t * sigma;
        let upper = |x: f64| 0.5 * libm::erfc(x * std::f64::consts::FRAC_1_SQRT_2);
        let (n, span) = (20_000, 10.0);
        (0..n)
            .map(|k| {
                let y = -span + (f64::from(k) + 0.5) * 2.0 * span / f64::from(n);
                let density = (-0.5 * y * y).exp() / std::f64::consts::TAU.sqrt();
                let inside = (reach * reach - (sigma * y).powi(2)).max(0.0).sqrt();
                density * (upper((inside - radius) / sigma) + upper((inside + radius) / sigma)) * 2.0 * span
                    / f64::from(n)
            })
            .sum()
    }

    #[test]
    fn the_bound_holds_against_the_integral() {
        for sigma in [0.05, 0.2, 0.4, 1.0, 5.0] {
            for t in [1.5, 3.0, 5.0, 7.0] {
                let offset = Vector2::new(5.0 + t * sigma, 0.0);
                let s = neg_log_p_outside(offset, &(Matrix2::identity() * sigma * sigma), 5.0);
                let p = exact(t, sigma, 5.0);
                // Laplace's method drops terms of relative order (t·σ/radius)²: a few per cent here.
                assert!(p <= 1.1 * (-s).exp(), "σ {sigma}, t {t}: {p} above e^-{s}");
                assert!(s >= 0.5 * t * t);
            }
        }
    }

    #[test]
    fn a_sum_of_exponential_variables_follows_erlang() {
        assert_eq!(neg_log_p_of_sum(&[3.0]), 3.0);
        // P(S₁ + S₂ > 5) = e⁻⁵(1 + 5); P(S₁ + S₂ + S₃ > 6) = e⁻⁶(1 + 6 + 18).
        assert!((neg_log_p_of_sum(&[2.0, 3.0]) - (5.0 - 6f64.ln())).abs() < 1e-12);
        assert!((neg_log_p_of_sum(&[1.0, 2.0, 3.0]) - (6.0 - 25f64.ln())).abs() < 1e-12);
        // With nothing to add, each more of them makes the sum less surprising.
        assert!(neg_log_p_of_sum(&[5.0, 0.0]) < 5.0);
    }
}
