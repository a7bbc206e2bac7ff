//! Dark current of the pixels.

use rand::Rng;
use rand_distr::{Distribution, LogNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Charge that gathers without light, in joules of light that would give as much: a mean per exposure and, with `spread`, a
/// log-normal pattern of that relative standard deviation, the same in every frame. Its own shot noise comes with
/// `shot_noise`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DarkCurrent {
    pub energy_j: f64,
    #[serde(default)]
    pub spread: f64,
}

impl DarkCurrent {
    pub(in crate::scene) fn map<R: Rng + ?Sized>(&self, pixels: usize, rng: &mut R) -> Vec<f64> {
        if self.spread == 0.0 {
            return vec![self.energy_j; pixels];
        }
        let law = LogNormal::from_mean_cv(self.energy_j, self.spread).expect("both were validated");
        law.sample_iter(rng).take(pixels).collect()
    }
}

impl Table for DarkCurrent {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("energy_j").positive(self.energy_j)?;
        field.at("spread").non_negative(self.spread).map(drop)
    }
}
