//! Quantisation by the converter.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// The converter rounds to whole counts from 0 to 2^bits − 1. The black level is added before and taken off after, so that
/// noise below zero is not cut off. Rounding errs by joules_per_count/√12 (Widrow and Kollár, 2008, chapter 1).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quantisation {
    pub bits: u32,
    /// `optics.joules_per_count` when left out.
    pub joules_per_count: Option<f64>,
    #[serde(default)]
    pub black_level_counts: f64,
}

/// The converter with its step resolved.
#[derive(Clone, Copy, Debug)]
pub(in crate::scene) struct Converter {
    pub step_j: f64,
    black: f64,
    top: f64,
}

impl Quantisation {
    pub(in crate::scene) fn converter(&self, data_sheet: Option<f64>, field: &Key) -> Result<Converter, OutOfRange> {
        let field = field.at("joules_per_count");
        let Some(step) = self.joules_per_count.or(data_sheet) else {
            return Err(field.refuse("a value here or in optics.joules_per_count", "neither"));
        };
        Ok(Converter {
            step_j: field.positive(step)?,
            black: self.black_level_counts,
            top: 2f64.powi(self.bits as i32) - 1.0,
        })
    }
}

impl Converter {
    pub fn apply(&self, pixels: &mut [f64]) {
        for pixel in pixels {
            let counts = libm::round(*pixel / self.step_j + self.black);
            *pixel = (counts.clamp(0.0, self.top) - self.black) * self.step_j;
        }
    }
}

impl Table for Quantisation {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        if !(1..=32).contains(&self.bits) {
            return Err(field.at("bits").refuse("1 to 32", self.bits));
        }
        field
            .at("black_level_counts")
            .non_negative(self.black_level_counts)
            .map(drop)
    }
}
