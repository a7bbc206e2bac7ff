//! Pointing error of the beams.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// The beam misses the lens by r_p, two independent N(μ_p, σ_p²); the lens then collects exp(−2‖r_p‖²/w_z²) of what it would
/// (Farid and Hranilovic, 2007, eq. 9, for w_z ≫ r_a). With zero μ_p the mean is w_z²/(w_z² + 4σ_p²).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pointing {
    /// σ_p.
    pub jitter_m: f64,
    /// μ_p.
    #[serde(default)]
    pub boresight_m: [f64; 2],
}

impl Pointing {
    /// Draws ‖r_p‖², m².
    pub(in crate::scene) fn squared_miss<R: Rng + ?Sized>(&self, rng: &mut R) -> f64 {
        let axis = |mean: f64, rng: &mut R| {
            let z: f64 = StandardNormal.sample(rng);
            (mean + self.jitter_m * z).powi(2)
        };
        axis(self.boresight_m[0], rng) + axis(self.boresight_m[1], rng)
    }
}

impl Table for Pointing {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("jitter_m").non_negative(self.jitter_m)?;
        field.at("boresight_m").finite_pair(self.boresight_m).map(drop)
    }
}
