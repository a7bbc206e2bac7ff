//! Photo-response non-uniformity.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Photo-response non-uniformity: each pixel's sensitivity is 1 + std·z, z standard normal and the same in every frame
/// (EMVA 1288, release 4.0, section 8). Never below zero.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gain {
    pub std: f64,
}

impl Gain {
    pub(in crate::scene) fn map<R: Rng + ?Sized>(&self, pixels: usize, rng: &mut R) -> Vec<f64> {
        let one = |z: f64| (1.0 + self.std * z).max(0.0);
        (0..pixels).map(|_| one(StandardNormal.sample(rng))).collect()
    }
}

impl Table for Gain {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("std").non_negative(self.std).map(drop)
    }
}
