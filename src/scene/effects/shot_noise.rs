//! Shot noise of the light.

use rand::Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Light comes in quanta of q joules of collected energy: a pixel that expects y reads q·Poisson(y/q), of variance q·y. q is
/// hc/λ over the detector's excess noise factor's reciprocal, i.e. F·hc/λ.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShotNoise {
    /// q; or give the wavelength.
    pub quantum_j: Option<f64>,
    pub wavelength_m: Option<f64>,
    /// F, 1 for a photodiode without gain.
    #[serde(default = "unity")]
    pub excess_factor: f64,
}

/// hc, J·m (exact in the SI of 2019).
const PLANCK_LIGHT_J_M: f64 = 6.626_070_15e-34 * 299_792_458.0;

/// From this mean on the normal law with the same mean and variance stands for Poisson's: their distribution functions differ
/// by at most 0.4748/√λ < 5·10⁻⁴ (Berry and Esseen, with Shevtsova's constant, 2011).
const NORMAL_FROM: f64 = 1e6;

fn unity() -> f64 {
    1.0
}

impl ShotNoise {
    pub(in crate::scene) fn quantum(&self, field: &Key) -> Result<f64, OutOfRange> {
        let factor = field.at("excess_factor").positive(self.excess_factor)?;
        match (self.quantum_j, self.wavelength_m) {
            (Some(q), None) => Ok(factor * field.at("quantum_j").positive(q)?),
            (None, Some(wavelength)) => Ok(factor * PLANCK_LIGHT_J_M / field.at("wavelength_m").positive(wavelength)?),
            both => Err(field.refuse("either quantum_j or wavelength_m", both)),
        }
    }

    /// Draws every pixel anew about its expectation.
    pub(in crate::scene) fn apply<R: Rng + ?Sized>(quantum_j: f64, pixels: &mut [f64], rng: &mut R) {
        for pixel in pixels {
            let mean = *pixel / quantum_j;
            if mean >= NORMAL_FROM {
                let z: f64 = StandardNormal.sample(rng);
                *pixel += (quantum_j * *pixel).sqrt() * z;
            } else if let Ok(law) = Poisson::new(mean) {
                *pixel = quantum_j * law.sample(rng);
            } else {
                // No light, no quanta; Poisson's law refuses a mean of zero.
                *pixel = 0.0;
            }
        }
    }
}

impl Table for ShotNoise {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        self.quantum(field).map(drop)
    }
}
