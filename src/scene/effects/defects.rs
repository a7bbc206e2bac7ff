//! Dead and hot pixels.

use ndarray::Array2;
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Pixels that are dead (read nothing) or hot (read a fixed energy too much), each pixel with the given probability, the same
/// in every frame.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Defects {
    pub dead: f64,
    pub hot: f64,
    pub hot_j: f64,
    /// Whether frames come with these pixels masked.
    pub masked: bool,
}

/// The defective pixels of an array.
#[derive(Debug)]
pub(in crate::scene) struct DefectMap {
    dead: Vec<usize>,
    hot: Vec<usize>,
    hot_j: f64,
    pub mask: Option<Array2<bool>>,
}

impl Defects {
    /// `shape` is (Ny, Nx).
    pub(in crate::scene) fn map<R: Rng + ?Sized>(&self, shape: (usize, usize), rng: &mut R) -> DefectMap {
        let (mut dead, mut hot) = (Vec::new(), Vec::new());
        let mut mask = Array2::from_elem(shape, false);
        for (index, bad) in mask.iter_mut().enumerate() {
            let u: f64 = rng.random();
            if u < self.dead {
                dead.push(index);
            } else if u < self.dead + self.hot {
                hot.push(index);
            } else {
                continue;
            }
            *bad = true;
        }
        DefectMap {
            dead,
            hot,
            hot_j: self.hot_j,
            mask: self.masked.then_some(mask),
        }
    }
}

impl DefectMap {
    /// Row-major indices of the broken pixels.
    pub fn broken(&self) -> impl Iterator<Item = usize> {
        self.dead.iter().chain(&self.hot).copied()
    }

    pub fn apply(&self, pixels: &mut [f64]) {
        for &index in &self.dead {
            pixels[index] = 0.0;
        }
        for &index in &self.hot {
            pixels[index] += self.hot_j;
        }
    }
}

impl Table for Defects {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("dead").fraction(self.dead)?;
        field.at("hot").fraction(self.hot)?;
        if self.dead + self.hot > 1.0 {
            return Err(field.at("hot").refuse("at most 1 − dead", self.hot));
        }
        field.at("hot_j").non_negative(self.hot_j).map(drop)
    }
}
