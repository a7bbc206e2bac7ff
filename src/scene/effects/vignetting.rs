//! Vignetting of the lens.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// The lens passes less light away from its axis: 1 − loss·(r/R)², R the half-diagonal of the sensor. A far emitter's
/// whole beam loses alike; background light loses pixel by pixel.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vignetting {
    /// Share lost in the corner.
    pub corner_loss: f64,
}

impl Vignetting {
    /// Share passed at a squared radius of `corner_ratio2` half-diagonals.
    pub(in crate::scene) fn passed(&self, corner_ratio2: f64) -> f64 {
        (1.0 - self.corner_loss * corner_ratio2).max(0.0)
    }
}

impl Table for Vignetting {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("corner_loss").fraction(self.corner_loss).map(drop)
    }
}
