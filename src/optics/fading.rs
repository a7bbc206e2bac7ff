//! Gamma–Gamma statistics of turbulence-induced fading.
//!
//! The fading ρ is the product of independent Gamma(α, 1/α) and Gamma(β, 1/β) variates, of unit mean: large eddies
//! modulate what small eddies scatter (Al-Habash, Andrews and Phillips, 2001, "Mathematical model for the irradiance
//! probability density function of a laser beam propagating through turbulent media").

use std::f64::consts::PI;

/// Parameters of the Gamma–Gamma law; both positive, neither needs to be the larger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GammaGamma {
    pub alpha: f64,
    pub beta: f64,
}

/// Shape of the wave that meets the turbulence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wave {
    Plane,
    /// A point source, or a diverging beam seen from far away: a ground user's.
    Spherical,
}

/// Rytov variance σ_R² = 1.23·C_n²·k^(7/6)·L^(11/6) of a plane wave in turbulence of constant strength C_n² (m^(−2/3)) over
/// `length_m`, k = 2π/λ (Andrews and Phillips, 2005, eq. 5.15 with 8.24).
pub fn rytov_variance(cn2: f64, wavelength_m: f64, length_m: f64) -> f64 {
    let k = 2.0 * PI / wavelength_m;
    1.23 * cn2 * k.powf(7.0 / 6.0) * length_m.powf(11.0 / 6.0)
}

impl GammaGamma {
    /// The law for a Rytov variance σ_R² > 0, a point receiver and no inner scale: α = 1/(exp σ²_lnX − 1) and
    /// β = 1/(exp σ²_lnY − 1) (Andrews and Phillips, 2005, eqs. 9.43 to 9.46 for the plane and 9.60 to 9.63 for the spherical wave,
    /// whose own Rytov variance is β₀² = 0.4σ_R²). α and β grow without bound as σ_R² → 0.
    pub fn from_rytov(variance: f64, wave: Wave) -> Self {
        let (v, large, small) = match wave {
            Wave::Plane => (variance, 1.11, 0.69),
            Wave::Spherical => (0.4 * variance, 0.56, 0.69),
        };
        let v65 = v.powf(6.0 / 5.0);
        let ln_x = 0.49 * v / (1.0 + large * v65).powf(7.0 / 6.0);
        let ln_y = 0.51 * v / (1.0 + small * v65).powf(5.0 / 6.0);
        Self {
            alpha: f64::exp_m1(ln_x).recip(),
            beta: f64::exp_m1(ln_y).recip(),
        }
    }

    /// Scintillation index, the variance of ρ: 1/α + 1/β + 1/(αβ).
    pub fn scintillation_index(&self) -> f64 {
        let (a, b) = (self.alpha.recip(), self.beta.recip());
        a + b + a * b
    }

    /// E[ρ^k] = Γ(α + k)Γ(β + k)/(Γ(α)Γ(β)(αβ)^k); infinite where k ≤ −min(α, β).
    pub fn moment(&self, k: f64) -> f64 {
        if k <= -self.alpha.min(self.beta) {
            return f64::INFINITY;
        }
        (ln_gamma_moment(self.alpha, k) + ln_gamma_moment(self.beta, k)).exp()
    }

    /// Density of ρ at `rho`; 0 below zero. At zero it is the limit, infinite where min(α, β) < 1 or α = β = 1.
    pub fn density(&self, rho: f64) -> f64 {
        self.ln_density(rho).exp()
    }

    /// Logarithm of the density
    /// f(ρ) = 2(αβ)^((α+β)/2)/(Γ(α)Γ(β))·ρ^((α+β)/2−1)·K_{α−β}(2√(αβρ)) (Al-Habash et al., 2001, eq. 9).
    ///
    /// Arranged so that the large terms cancel on paper: with A ≥ B the parameters in order, ν = A − B,
    /// r = √(ν² + 4αβρ), D = 4αβ(1 − ρ)/(α + β + r) and δ the remainder of Stirling's formula,
    /// ln f = ½ln(αβ) − ln 2π − δ(α) − δ(β) + D + ν·ln(1 − D/2A) + (B − 1)·ln ρ + ln S,
    /// S = 2·K_ν(x)·exp(r − ν·asinh(ν/x)) at x = 2√(αβρ).
    pub fn ln_density(&self, rho: f64) -> f64 {
        let (large, small) = (self.alpha.max(self.beta), self.alpha.min(self.beta));
        if rho < 0.0 || rho == f64::INFINITY {
            return f64::NEG_INFINITY;
        }
        if rho == 0.0 {
            return self.ln_density_at_zero();
        }
        let nu = large - small;
        let x = 2.0 * (large * small).sqrt() * rho.sqrt();
        let r = nu.hypot(x);
        let d = 4.0 * large * small * (1.0 - rho) / (large + small + r);
        let tilt = if nu == 0.0 {
            0.0
        } else {
            nu * f64::ln_1p(-0.5 * d / large)
        };
        0.5 * (large * small).ln() - (2.0 * PI).ln() - stirling_remainder(large) - stirling_remainder(small)
            + d
            + tilt
            + (small - 1.0) * rho.ln()
            + scaled_bessel_integral(nu, r, x).ln()
    }

    /// lim ρ→0 of ln f: f ~ Γ(A − B)/(Γ(A)Γ(B))·(AB)^B·ρ^(B−1), and for A = B logarithmic in ρ besides.
    fn ln_density_at_zero(&self) -> f64 {
        let (large, small) = (self.alpha.max(self.beta), self.alpha.min(self.beta));
        if small > 1.0 {
            f64::NEG_INFINITY
        } else if small < 1.0 || large == 1.0 {
            f64::INFINITY
        } else {
            // B = 1: Γ(A − 1)/Γ(A)·A = A/(A − 1).
            (large / (large - 1.0)).ln()
        }
    }
}

/// ∫ exp(−p(eˢ − 1 − s) − q(e⁻ˢ − 1 + s)) ds over the line, p = (r + ν)/2, q = (r − ν)/2, r² = ν² + x².
///
/// It is 2·K_ν(x)·exp(r − ν·asinh(ν/x)): K_ν(x) = ½∫exp(νt − x cosh t) dt (Abramowitz and Stegun, 1964, eq. 9.6.24) taken
/// about its saddle point sinh t = ν/x. The trapezoidal rule converges exponentially (Trefethen and Weideman, 2014,
/// theorem 5.1); the step keeps its error below exp(−36).
fn scaled_bessel_integral(nu: f64, r: f64, x: f64) -> f64 {
    let p = 0.5 * (r + nu);
    // Not x²: it may underflow, and the left tail without q never ends.
    let q = (0.5 * x * (x / (r + nu))).max(f64::MIN_POSITIVE);
    let step = (0.6 / r.sqrt()).min(0.2);
    let exponent = |s: f64| p * beyond_linear(s) + q * beyond_linear(-s);
    let mut sum = 1.0;
    for side in [step, -step] {
        let mut k = 1.0;
        let mut term = 1.0;
        // The integrand falls monotonically from s = 0; NaN ends the sum too.
        while term > 1e-18 * sum {
            term = (-exponent(k * side)).exp();
            sum += term;
            k += 1.0;
        }
    }
    sum * step
}

/// eˢ − 1 − s, by its series where the difference would leave no digits.
fn beyond_linear(s: f64) -> f64 {
    if s.abs() > 0.05 {
        return f64::exp_m1(s) - s;
    }
    // 1/k!, k from 2 to 9: what is left out is below s⁸/10⁶ of the sum.
    const SERIES: [f64; 8] = [
        1.0 / 2.0,
        1.0 / 6.0,
        1.0 / 24.0,
        1.0 / 120.0,
        1.0 / 720.0,
        1.0 / 5040.0,
        1.0 / 40_320.0,
        1.0 / 362_880.0,
    ];
    s * s * SERIES.iter().rev().fold(0.0, |sum, c| sum * s + c)
}

/// ln E[X^k] of X ~ Gamma(shape, 1/shape): ln Γ(shape + k) − ln Γ(shape) − k ln shape, without their cancellation.
fn ln_gamma_moment(shape: f64, k: f64) -> f64 {
    (shape + k - 0.5) * f64::ln_1p(k / shape) - k + stirling_remainder(shape + k) - stirling_remainder(shape)
}

/// δ(z) = ln Γ(z) − [(z − ½)ln z − z + ½ln 2π], z > 0 (Abramowitz and Stegun, 1964, eq. 6.1.42 for z ≥ 10).
fn stirling_remainder(z: f64) -> f64 {
    const HALF_LN_2PI: f64 = 0.918_938_533_204_672_7;
    /// B₂ₖ/(2k(2k − 1)).
    const SERIES: [f64; 8] = [
        1.0 / 12.0,
        -1.0 / 360.0,
        1.0 / 1260.0,
        -1.0 / 1680.0,
        1.0 / 1188.0,
        -691.0 / 360_360.0,
        1.0 / 156.0,
        -3617.0 / 122_400.0,
    ];
    if z < 10.0 {
        return libm::lgamma(z) - ((z - 0.5) * z.ln() - z + HALF_LN_2PI);
    }
    let w = z.recip() * z.recip();
    SERIES.iter().rev().fold(0.0, |sum, c| sum * w + c) / z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_scene() {
        let law = GammaGamma { alpha: 4.0, beta: 2.0 };
        assert_eq!(law.scintillation_index(), 0.875);
        assert!((law.moment(1.0) - 1.0).abs() < 1e-14);
        assert!((law.moment(2.0) - 1.875).abs() < 1e-14);
    }

    #[test]
    fn weak_turbulence_scintillates_by_the_rytov_variance() {
        // To first order σ_I² = σ_R² (plane) and 0.4σ_R² (spherical); the next order is σ_R^(22/5) relative to it.
        for (wave, factor) in [(Wave::Plane, 1.0), (Wave::Spherical, 0.4)] {
            let si = GammaGamma::from_rytov(1e-6, wave).scintillation_index();
            assert!((si / (factor * 1e-6) - 1.0).abs() < 1e-5, "{wave:?}: {si}");
        }
    }

    #[test]
    fn the_density_does_not_care_for_the_order_of_its_parameters() {
        for rho in [1e-6, 0.3, 1.0, 7.0] {
            let f = GammaGamma { alpha: 0.7, beta: 91.0 }.ln_density(rho);
            assert_eq!(f, GammaGamma { alpha: 91.0, beta: 0.7 }.ln_density(rho));
        }
    }

    #[test]
    fn huge_parameters_are_a_narrow_normal() {
        // α = β = 1e8: variance 2e-8; at the mean the density is 1/√(2π·2e-8) to first order in 1/α.
        let law = GammaGamma { alpha: 1e8, beta: 1e8 };
        let expected = -0.5 * (2.0 * PI * 2e-8).ln();
        assert!((law.ln_density(1.0) - expected).abs() < 1e-7);
    }

    /// α = β and ρ so small that their product underflows: the integrand has no tail to end at but its exponential one.
    #[test]
    fn the_smallest_numbers_come_to_an_end() {
        for rho in [5e-324, 1e-310, 1e-300] {
            let f = GammaGamma {
                alpha: 0.05,
                beta: 0.05,
            }
            .ln_density(rho);
            // f ~ (αβ)^α/Γ(α)²·ρ^(α−1)·(−ln(αβρ) − 2γ) as ρ → 0 (Abramowitz and Stegun, 1964, eq. 9.6.8).
            let ln = f64::ln(0.0025) + f64::ln(rho);
            let expected = 0.05 * f64::ln(0.0025) - 2.0 * libm::lgamma(0.05) - 0.95 * f64::ln(rho)
                + (-ln - 2.0 * 0.577_215_664_901_532_9).ln();
            assert!((f / expected - 1.0).abs() < 1e-12, "{rho}: {f} against {expected}");
        }
    }

    /// Far out the integrand is so narrow that eˢ − 1 − s has no digits left.
    #[test]
    fn the_largest_numbers_come_to_an_end() {
        for (alpha, beta) in [(0.05, 0.05), (4.0, 2.0), (1e4, 60.0), (1e4, 1e4)] {
            for rho in [1e3, 1e30, 1e150, 1e300] {
                let f = GammaGamma { alpha, beta }.ln_density(rho);
                // f falls as exp(−2√(αβρ)); ln ρ and constants are small beside it from 1e30 on.
                let leading = -2.0 * f64::sqrt(alpha * beta) * f64::sqrt(rho);
                assert!(
                    f < 0.0 && (rho < 1e30 || f == f64::NEG_INFINITY || (f / leading - 1.0).abs() < 1e-6),
                    "{alpha} {beta} {rho}: {f}"
                );
            }
        }
    }

    #[test]
    fn the_ends_of_the_axis() {
        let law = |alpha, beta| GammaGamma { alpha, beta };
        assert_eq!(law(4.0, 2.0).density(0.0), 0.0);
        assert_eq!(law(4.0, 0.5).density(0.0), f64::INFINITY);
        assert_eq!(law(4.0, 1.0).density(0.0), law(1.0, 4.0).density(0.0));
        assert!((law(4.0, 1.0).density(0.0) - 4.0 / 3.0).abs() < 1e-15);
        assert_eq!(law(4.0, 2.0).density(-1.0), 0.0);
        assert_eq!(law(4.0, 2.0).density(f64::INFINITY), 0.0);
        assert!(law(4.0, 2.0).density(f64::NAN).is_nan());
    }
}
