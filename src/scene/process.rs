//! A stationary Gaussian process that can be evaluated at any time without earlier values.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

/// Spectral representation (Shinozuka and Deodatis, 1991, "Simulation of stochastic processes by spectral
/// representation", eq. 30, with frequencies drawn from the spectrum): √(2/M)·Σ cos(ω_m t + φ_m).
///
/// Zero mean, unit variance, autocovariance exp(−τ²/2T²) over seeds. Gaussian to the extent that [`TERMS`] cosines are:
/// excess kurtosis −1.5/TERMS.
#[derive(Debug)]
pub(super) struct GaussianProcess {
    /// (ω in rad/s, φ in rad).
    terms: Box<[(f64, f64); TERMS]>,
}

const TERMS: usize = 32;

impl GaussianProcess {
    /// Draws a process with correlation time `time_s` = T.
    pub fn new(rng: &mut impl Rng, time_s: f64) -> Self {
        Self {
            terms: Box::new(std::array::from_fn(|_| {
                let frequency: f64 = StandardNormal.sample(rng);
                (frequency / time_s, TAU * rng.random::<f64>())
            })),
        }
    }

    /// Value at `t` seconds.
    pub fn at(&self, t: f64) -> f64 {
        let sum: f64 = self.terms.iter().map(|(w, phase)| libm::cos(w * t + phase)).sum();
        (2.0 / TERMS as f64).sqrt() * sum
    }
}
