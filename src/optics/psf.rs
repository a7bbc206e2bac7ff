//! The pixel-integrated Gaussian spot and its derivatives.

use std::f64::consts::FRAC_1_SQRT_2;

use super::Axis;

/// Fraction of a unit-energy spot of width `sigma` at `centre` that falls between `lo` and `hi`
/// (all m): ΔΦ = Φ((hi − c)/σ) − Φ((lo − c)/σ), computed in the form of the nearer tail so that its
/// relative error stays small far from the spot.
pub fn pixel_fraction(lo: f64, hi: f64, centre: f64, sigma: f64) -> f64 {
    let a = (lo - centre) / sigma;
    let b = (hi - centre) / sigma;
    let upper = |t: f64| 0.5 * libm::erfc(t * FRAC_1_SQRT_2);
    if a > 0.0 {
        upper(a) - upper(b)
    } else if b < 0.0 {
        upper(-b) - upper(-a)
    } else {
        0.5 * (libm::erf(b * FRAC_1_SQRT_2) - libm::erf(a * FRAC_1_SQRT_2))
    }
}

/// The spot's profile along one axis: `out[k]` is the fraction that pixel k collects. `out.len() == axis.n`.
pub fn profile(axis: &Axis, centre: f64, sigma: f64, out: &mut [f64]) {
    for (k, value) in out.iter_mut().enumerate() {
        *value = pixel_fraction(axis.edge(k), axis.edge(k + 1), centre, sigma);
    }
}
