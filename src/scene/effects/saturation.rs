//! Saturation of pixels, with blooming.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// A pixel carries no more than the level; with blooming, what is above it spills in equal halves up and down the column,
/// each full pixel passing on what it cannot hold, until it is taken up or leaves the array.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Saturation {
    /// `optics.saturation_j` when left out.
    pub level_j: Option<f64>,
    /// Share of the excess that spills; 0 is an array with perfect anti-blooming drains.
    pub blooming: f64,
}

impl Saturation {
    /// Spills the excess along the columns of `pixels`, row-major with rows of `nx`. Full pixels keep at least the level:
    /// the read-out clips them.
    pub(in crate::scene) fn bloom(&self, level_j: f64, nx: usize, pixels: &mut [f64]) {
        let ny = pixels.len() / nx;
        for column in 0..nx {
            let at = |row: usize| row * nx + column;
            let excess: Vec<f64> = (0..ny).map(|row| (pixels[at(row)] - level_j).max(0.0)).collect();
            if excess.iter().all(|e| *e == 0.0) {
                continue;
            }
            for upward in [true, false] {
                let mut carried = 0.0;
                for step in 0..ny {
                    let row = if upward { step } else { ny - 1 - step };
                    let pixel = &mut pixels[at(row)];
                    let room = (level_j - *pixel).max(0.0);
                    let taken = room.min(carried);
                    *pixel += taken;
                    carried += 0.5 * self.blooming * excess[row] - taken;
                }
            }
        }
    }

    /// Cuts every pixel at the level.
    pub(in crate::scene) fn clip(level_j: f64, pixels: &mut [f64]) {
        for pixel in pixels {
            *pixel = pixel.min(level_j);
        }
    }
}

impl Table for Saturation {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        if let Some(level) = self.level_j {
            field.at("level_j").positive(level)?;
        }
        field.at("blooming").fraction(self.blooming).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blooming_keeps_the_energy_that_stays_on_the_array() {
        let table = Saturation {
            level_j: None,
            blooming: 1.0,
        };
        let mut pixels = vec![0.0; 9 * 3];
        pixels[4 * 3 + 1] = 4.0;
        pixels[5 * 3 + 1] = 0.5;
        table.bloom(1.0, 3, &mut pixels);
        Saturation::clip(1.0, &mut pixels);
        assert!((pixels.iter().sum::<f64>() - 4.5).abs() < 1e-12);
        let column: Vec<f64> = (0..9).map(|row| pixels[row * 3 + 1]).collect();
        assert_eq!(column, [0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]);
    }
}
