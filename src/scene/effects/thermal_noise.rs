//! Additive read-out noise.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Additive white Gaussian noise of the read-out, σ_n joules per pixel (`meas_total`).
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThermalNoise {
    /// `optics.noise_std_j` when left out.
    pub std_j: Option<f64>,
}

impl ThermalNoise {
    /// Adds noise of `std_j` to every pixel.
    pub(in crate::scene) fn add<R: Rng + ?Sized>(std_j: f64, pixels: &mut [f64], rng: &mut R) {
        for pixel in pixels {
            let z: f64 = StandardNormal.sample(rng);
            *pixel += std_j * z;
        }
    }
}

impl Table for ThermalNoise {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        self.std_j.map_or(Ok(()), |s| field.at("std_j").positive(s).map(drop))
    }
}
