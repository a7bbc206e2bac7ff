//! The pixel-integrated Gaussian spot and its derivatives.
//!
//! A pixel between the edges `lo` and `hi` collects ΔΦ = Φ(b) − Φ(a) of a unit-energy spot along one axis, with
//! a = (lo − c)/σ and b = (hi − c)/σ (`yji_z` of the paper, energy-conserving form). As written that is a difference of
//! nearly equal numbers in the tails and for narrow pixels, so each regime has its own form. Below,
//! m = (a + b)/2, h = (b − a)/2, φ is the standard normal density and Φ its integral.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use super::Axis;

/// Beyond this many σ the density underflows: exp(−39²/2) is below the smallest f64.
const DARK: f64 = 39.0;

/// What one pixel collects along one axis, and how that changes as the spot moves or widens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelResponse {
    /// ΔΦ.
    pub fraction: f64,
    /// ∂ΔΦ/∂c, 1/m.
    pub d_centre: f64,
    /// ∂ΔΦ/∂σ, 1/m.
    pub d_sigma: f64,
}

/// Fraction of a unit-energy spot of width `sigma` at `centre` that falls between `lo` and `hi`
/// (all m, lo ≤ hi, sigma > 0): ΔΦ = Φ((hi − c)/σ) − Φ((lo − c)/σ).
///
/// Relative error below 1e-12 from the centre to 30σ out (where the result leaves the normal range of f64 at 38σ), for
/// pixels of any width; tests/reference holds it to that.
pub fn pixel_fraction(lo: f64, hi: f64, centre: f64, sigma: f64) -> f64 {
    let (a, b) = ((lo - centre) / sigma, (hi - centre) / sigma);
    fraction(a, b, 0.5 * (hi - lo) / sigma)
}

/// [`pixel_fraction`] with its derivatives:
/// ∂ΔΦ/∂c = (φ(a) − φ(b))/σ and ∂ΔΦ/∂σ = (a φ(a) − b φ(b))/σ, both without the cancellation of narrow pixels.
pub fn pixel_response(lo: f64, hi: f64, centre: f64, sigma: f64) -> PixelResponse {
    let (a, b) = ((lo - centre) / sigma, (hi - centre) / sigma);
    let half = 0.5 * (hi - lo) / sigma;
    // Mirrored so that the pixel's middle is on the positive side; there φ(a) ≥ φ(b) and only c's derivative is odd.
    let (near, far, sign) = if a + b >= 0.0 { (a, b, 1.0) } else { (-b, -a, -1.0) };
    if near > DARK {
        return PixelResponse {
            fraction: 0.0,
            d_centre: 0.0,
            d_sigma: 0.0,
        };
    }
    let middle = 0.5 * (near + far);
    let density = normal_density(near);
    // φ(far)/φ(near) = exp(−2mh).
    let decay = 2.0 * middle * half;
    let slope = -density * f64::exp_m1(-decay);
    let stretch = if decay < 1.0 {
        // a φ(a) − b φ(b) = 2 h φ(m) exp(−h²/2)·(m² sinh(mh)/(mh) − cosh(mh)), and φ(m) exp(−h²/2) = φ(near) exp(−mh).
        let t = middle * half;
        2.0 * half * density * (-t).exp() * (middle * middle * sinh_over(t) - t.cosh())
    } else {
        density * (near - far * (-decay).exp())
    };
    PixelResponse {
        fraction: fraction(a, b, half),
        d_centre: sign * slope / sigma,
        d_sigma: stretch / sigma,
    }
}

/// The spot's profile along one axis: `out[k]` is the fraction that pixel k collects. `out.len() == axis.n`.
pub fn profile(axis: &Axis, centre: f64, sigma: f64, out: &mut [f64]) {
    for (k, value) in out.iter_mut().enumerate() {
        *value = pixel_fraction(axis.edge(k), axis.edge(k + 1), centre, sigma);
    }
}

/// The spot's profile and its derivatives along one axis. `out.len() == axis.n`.
pub fn profile_response(axis: &Axis, centre: f64, sigma: f64, out: &mut [PixelResponse]) {
    for (k, value) in out.iter_mut().enumerate() {
        *value = pixel_response(axis.edge(k), axis.edge(k + 1), centre, sigma);
    }
}

/// ΔΦ between a and b; `half` is (b − a)/2, formed from the edges themselves because a and b have lost it when the
/// pixel is narrow and far away.
fn fraction(a: f64, b: f64, half: f64) -> f64 {
    if a > DARK || b < -DARK {
        return 0.0;
    }
    let middle = 0.5 * (a + b);
    // Where erfc(a) and erfc(b) share more than a digit or so, integrate instead.
    if half <= 0.25 && middle.abs() * half <= 1.0 {
        return 2.0 * normal_density(middle) * hermite_sum(middle, half);
    }
    let upper = |t: f64| 0.5 * libm::erfc(t * FRAC_1_SQRT_2);
    if a > 0.0 {
        upper(a) - upper(b)
    } else if b < 0.0 {
        upper(-b) - upper(-a)
    } else {
        0.5 * (libm::erf(b * FRAC_1_SQRT_2) - libm::erf(a * FRAC_1_SQRT_2))
    }
}

/// ∫₀ʰ cosh(mu) exp(−u²/2) du = Σ He₂ₖ(m) h²ᵏ⁺¹/(2k+1)!, from the generating function of the Hermite polynomials
/// (Abramowitz and Stegun, 1964, eq. 22.9.17). For h ≤ 1/4 and |m|h ≤ 1.
fn hermite_sum(m: f64, h: f64) -> f64 {
    let h2 = h * h;
    let m2 = m * m;
    // e_k = He_k(m)·h^k/k!, even k only: He_{k+2} = (m² − 2k − 1)·He_k − k(k − 1)·He_{k−2}.
    let (mut previous, mut current) = (0.0, 1.0);
    let mut sum = 1.0;
    let mut k = 0.0;
    while k < 40.0 {
        let next = ((m2 - 2.0 * k - 1.0) * h2 * current - h2 * h2 * previous) / ((k + 1.0) * (k + 2.0));
        (previous, current) = (current, next);
        k += 2.0;
        let term = current / (k + 1.0);
        sum += term;
        // Two small terms in a row: one alone may be a zero of its polynomial.
        if current.abs() + previous.abs() * h2 <= 1e-17 * sum {
            break;
        }
    }
    h * sum
}

fn normal_density(t: f64) -> f64 {
    (-0.5 * t * t).exp() / (2.0 * PI).sqrt()
}

/// sinh(t)/t for 0 ≤ t.
fn sinh_over(t: f64) -> f64 {
    if t == 0.0 { 1.0 } else { t.sinh() / t }
}
