//! Background light of sky and ground.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::Camera;
use crate::toml_file::{Key, OutOfRange};

/// Light of sky and ground, an energy per pixel that is the same in every frame: uniform + gradient·(x/X, y/Y), X and Y the
/// half-widths of the sensor, and never below zero.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Background {
    pub uniform_j: f64,
    /// From the centre to the right and the upper edge.
    pub gradient_j: [f64; 2],
}

impl Background {
    /// Energy of the pixel in `row` and `column`, J.
    pub(in crate::scene) fn at(&self, camera: &Camera, row: usize, column: usize) -> f64 {
        let x = camera.x.centre(column) / camera.x.half_width();
        let y = camera.y.centre(row) / camera.y.half_width();
        (self.uniform_j + self.gradient_j[0] * x + self.gradient_j[1] * y).max(0.0)
    }

    /// Its brightest pixel, J.
    pub(in crate::scene) fn brightest(&self) -> f64 {
        self.uniform_j + self.gradient_j[0].abs() + self.gradient_j[1].abs()
    }
}

impl Table for Background {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("uniform_j").non_negative(self.uniform_j)?;
        field.at("gradient_j").finite_pair(self.gradient_j).map(drop)
    }
}
