//! Power that a ground emitter's beam sends through the lens.
//!
//! P_L = τ·ρ·g·I(r_p)·π r_a²·cos θ (`irradiance_flat_user`, `lens_power_user`) with the irradiance I of a Gaussian beam
//! taken as flat over the lens, which asks for w_z ≫ r_a. Otherwise P_L = τ·ρ·g·P·F·cos θ with F the fraction of the beam
//! that meets the disc of the lens ([`aperture_fraction`]). SI units.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Share of the power that the path lets through, g = exp(−κL); κ in 1/m (Beer–Lambert).
pub fn path_transmission(attenuation_per_m: f64, length_m: f64) -> f64 {
    (-attenuation_per_m * length_m).exp()
}

/// Irradiance, W/m², of a Gaussian beam of power P and radius w_z (1/e²) at `offset_m` from its axis:
/// (2P/(π w_z²))·exp(−2r²/w_z²) (Saleh and Teich, 2007, eq. 3.1-12).
pub fn irradiance(power_w: f64, beam_radius_m: f64, offset_m: f64) -> f64 {
    let r = offset_m / beam_radius_m;
    2.0 * power_w / (PI * beam_radius_m * beam_radius_m) * (-2.0 * r * r).exp()
}

/// Fraction of the beam's power that meets the lens, its irradiance taken as flat there:
/// (2 r_a²/w_z²)·exp(−2r²/w_z²). Its relative error is about (r_a/w_z)²·|1 − 2r²/w_z²|.
pub fn flat_aperture_fraction(lens_radius_m: f64, beam_radius_m: f64, offset_m: f64) -> f64 {
    irradiance(1.0, beam_radius_m, offset_m) * PI * lens_radius_m * lens_radius_m
}

/// Fraction of the beam's power that meets the lens: the Gaussian's integral over the disc, centred `offset_m` off
/// the beam's axis, 1 − Q₁(2r/w_z, 2r_a/w_z) with Q₁ Marcum's function, i.e. the distribution function of a
/// non-central χ² variate of two degrees of freedom.
///
/// Relative error below 1e-12 wherever the result is normal; takes O(r_a/w_z) evaluations of erf.
pub fn aperture_fraction(lens_radius_m: f64, beam_radius_m: f64, offset_m: f64) -> f64 {
    // In units of the beam's standard deviation w_z/2.
    let a = 2.0 * offset_m.abs() / beam_radius_m;
    let b = 2.0 * lens_radius_m / beam_radius_m;
    if a.is_nan() || b.is_nan() {
        return f64::NAN;
    }
    // Beyond 39 standard deviations from the rim the missing part is below the smallest number.
    if b - a > 39.0 {
        return 1.0;
    }
    if a - b > 39.0 {
        return 0.0;
    }
    // Sliced into chords at x = b cos θ, ∫₀^π φ(b cos θ − a)·erf(b sin θ/√2)·b sin θ dθ: entire, even and periodic, so the
    // trapezoidal rule converges exponentially once its step resolves the narrowest feature (Trefethen and Weideman,
    // 2014, theorem 3.2).
    let n = 48 + (6.0 * (b + (a * b).sqrt())).ceil() as usize;
    let step = PI / n as f64;
    let sum: f64 = (1..n)
        .map(|k| {
            let (sin, cos) = (k as f64 * step).sin_cos();
            let x = b * cos - a;
            (-0.5 * x * x).exp() * libm::erf(b * sin * FRAC_1_SQRT_2) * sin
        })
        .sum();
    (sum * b * step / (2.0 * PI).sqrt()).min(1.0)
}

/// Mean over the pointing offset of exp(−2k‖r_p‖²/w_z²), r_p of two independent N(μ, σ_p²) components: the k-th moment of
/// the pointing loss, (1 + 4kσ_p²/w_z²)⁻¹·exp(−2k‖μ‖²/(w_z² + 4kσ_p²)) (moment-generating function of the non-central
/// χ² variate; Mathai and Provost, 1992, theorem 3.2a.1).
pub fn pointing_moment(order: f64, beam_radius_m: f64, mean_offset_m: [f64; 2], jitter_std_m: f64) -> f64 {
    let w2 = beam_radius_m * beam_radius_m;
    let spread = w2 + 4.0 * order * jitter_std_m * jitter_std_m;
    let mean2 = mean_offset_m[0] * mean_offset_m[0] + mean_offset_m[1] * mean_offset_m[1];
    w2 / spread * (-2.0 * order * mean2 / spread).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_centred_beam_has_the_closed_form() {
        for ratio in [1e-6, 0.01, 0.3, 1.0, 3.0, 12.0] {
            let exact = -f64::exp_m1(-2.0 * ratio * ratio);
            let fraction = aperture_fraction(ratio, 1.0, 0.0);
            assert!((fraction - exact).abs() < 1e-13 * exact, "{ratio}: {fraction} {exact}");
        }
    }

    #[test]
    fn a_wide_beam_is_flat_over_the_lens() {
        for offset in [0.0, 0.3, 1.0] {
            let flat = flat_aperture_fraction(1e-4, 1.0, offset);
            // (r_a/w_z)²·|1 − 2r²/w_z²| ≤ 1e-8.
            assert!((aperture_fraction(1e-4, 1.0, offset) - flat).abs() < 1.1e-8 * flat);
        }
    }

    #[test]
    fn extremes_stay_finite() {
        assert_eq!(aperture_fraction(0.05, 1e-9, 0.0), 1.0);
        assert_eq!(aperture_fraction(0.05, 1e-9, 1.0), 0.0);
        assert_eq!(aperture_fraction(0.0, 0.6, 0.1), 0.0);
        assert!(aperture_fraction(f64::NAN, 0.6, 0.1).is_nan());
    }

    #[test]
    fn pointing_of_the_papers_scene() {
        let mean = pointing_moment(1.0, 0.6, [0.0, 0.0], 0.1);
        assert!((mean - 0.9).abs() < 1e-15);
        assert_eq!(pointing_moment(2.0, 0.6, [0.0, 0.0], 0.0), 1.0);
    }
}
