//! The PSF along one axis in units of σ: pixel fractions with first and second derivatives, from tables of Φ and φ.
//!
//! Absolute accuracy 1e-15, which is what a fit needs; `optics::psf` is the reference with relative accuracy in
//! the tails.

use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::LazyLock;

/// Beyond this many σ both Φ and φ are constant to 1e-16.
pub(crate) const REACH: f64 = 8.5;
const KNOTS_PER_SIGMA: f64 = 64.0;

static TABLE: LazyLock<Vec<[f64; 2]>> = LazyLock::new(|| {
    let last = (REACH * KNOTS_PER_SIGMA) as i64 + 1;
    (-last..=last)
        .map(|k| {
            let t = k as f64 / KNOTS_PER_SIGMA;
            let density = (-0.5 * t * t).exp() * FRAC_1_SQRT_2 / std::f64::consts::PI.sqrt();
            [0.5 * libm::erfc(-t * FRAC_1_SQRT_2), density]
        })
        .collect()
});

/// (Φ(t), φ(t)) by a Taylor expansion from the nearest knot (Abramowitz and Stegun, 1964, 26.2.12 and 26.2.33).
#[inline(always)]
fn normal(table: &[[f64; 2]], t: f64) -> (f64, f64) {
    if t <= -REACH {
        return (0.0, 0.0);
    }
    if t >= REACH {
        return (1.0, 0.0);
    }
    let k = (t * KNOTS_PER_SIGMA).round();
    let u = k / KNOTS_PER_SIGMA;
    let d = t - u;
    let [cdf, density] = table[(k as i64 + (table.len() / 2) as i64) as usize];
    let u2 = u * u;
    // Hermite polynomials over factorials.
    let h1 = -u;
    let h2 = (u2 - 1.0) / 2.0;
    let h3 = -u * (u2 - 3.0) / 6.0;
    let h4 = ((u2 - 6.0) * u2 + 3.0) / 24.0;
    let h5 = -u * ((u2 - 10.0) * u2 + 15.0) / 120.0;
    let phi = density * (1.0 + d * (h1 + d * (h2 + d * (h3 + d * (h4 + d * h5)))));
    let integral = 1.0 + d * (h1 / 2.0 + d * (h2 / 3.0 + d * (h3 / 4.0 + d * (h4 / 5.0 + d * h5 / 6.0))));
    (cdf + density * d * integral, phi)
}

/// Writes f, f′, f″ (derivatives in the centre) of a spot of relative width `w` at `u` for the pixels between
/// `edges`, as far out as `reach` widths; all in units of σ. `f.len() + 1 == edges.len()`. Returns the range of pixels
/// that are non-zero; outside it nothing is written.
#[inline(always)]
pub(crate) fn profile(
    edges: &[f64],
    u: f64,
    w: f64,
    reach: f64,
    f: &mut [f64],
    f1: &mut [f64],
    f2: &mut [f64],
) -> std::ops::Range<usize> {
    let table: &[[f64; 2]] = &TABLE;
    let n = f.len();
    let pitch = edges[1] - edges[0];
    let pixel = |edge: f64| ((edge - edges[0]) / pitch).clamp(0.0, n as f64);
    let first = pixel(u - reach * w).floor() as usize;
    let last = pixel(u + reach * w).ceil() as usize;
    if first >= last {
        return first..first;
    }
    let inverse = 1.0 / w;
    let mut a = (edges[first] - u) * inverse;
    let (mut cdf_a, mut phi_a) = normal(table, a);
    for k in first..last {
        let b = (edges[k + 1] - u) * inverse;
        let (cdf_b, phi_b) = normal(table, b);
        f[k] = cdf_b - cdf_a;
        f1[k] = (phi_a - phi_b) * inverse;
        f2[k] = (a * phi_a - b * phi_b) * inverse * inverse;
        (a, cdf_a, phi_a) = (b, cdf_b, phi_b);
    }
    first..last
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::psf::pixel_fraction;

    #[test]
    fn profile_agrees_with_the_reference_and_with_its_own_differences() {
        let edges: Vec<f64> = (0..=40).map(|k| -4.0 + 0.2 * k as f64).collect();
        let n = edges.len() - 1;
        let (mut f, mut f1, mut f2) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let (mut lo, mut hi, mut t1, mut t2) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        for (u, w) in [(0.0, 1.0), (0.137, 0.93), (-3.71, 1.1), (5.2, 1.0)] {
            f.fill(0.0);
            lo.fill(0.0);
            hi.fill(0.0);
            f1.fill(0.0);
            f2.fill(0.0);
            profile(&edges, u, w, REACH, &mut f, &mut f1, &mut f2);
            let h = 1e-4;
            profile(&edges, u - h, w, REACH, &mut lo, &mut t1, &mut t2);
            profile(&edges, u + h, w, REACH, &mut hi, &mut t1, &mut t2);
            for k in 0..n {
                let exact = pixel_fraction(edges[k], edges[k + 1], u, w);
                assert!((f[k] - exact).abs() < 3e-15, "{u} {k}: {} against {exact}", f[k]);
                // Central differences: truncation h²/6·f‴ and f⁗ h²/12, cancellation 1e-16/h and 1e-16/h².
                assert!((f1[k] - (hi[k] - lo[k]) / (2.0 * h)).abs() < 1e-8);
                assert!((f2[k] - (hi[k] - 2.0 * f[k] + lo[k]) / (h * h)).abs() < 1e-6);
            }
        }
    }
}
