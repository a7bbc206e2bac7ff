//! Per-pixel corrections of one device, and their application to frames.

use ndarray::{Array2, Zip};

use super::error::CalibrationError;
use crate::frame::Frame;
use crate::toml_file::Key;

/// Per-pixel corrections, each of shape (Ny, Nx).
#[derive(Clone, Debug, PartialEq)]
pub struct PixelMaps {
    /// Response relative to the array's mean; positive.
    pub gain: Array2<f64>,
    /// What the pixel reads without light, J.
    pub dark_j: Array2<f64>,
    /// Pixels that carry no usable value.
    pub bad: Array2<bool>,
}

impl PixelMaps {
    /// A perfect array of shape (Ny, Nx).
    pub fn ideal(shape: (usize, usize)) -> Self {
        Self {
            gain: Array2::ones(shape),
            dark_j: Array2::zeros(shape),
            bad: Array2::from_elem(shape, false),
        }
    }

    pub(super) fn check(&self, (ny, nx): (usize, usize)) -> Result<(), CalibrationError> {
        for (map, dim) in [
            ("gain", self.gain.dim()),
            ("dark", self.dark_j.dim()),
            ("bad", self.bad.dim()),
        ] {
            if dim != (ny, nx) {
                return Err(CalibrationError::WrongShape {
                    map,
                    expected_x: nx,
                    expected_y: ny,
                    found_x: dim.1,
                    found_y: dim.0,
                });
            }
        }
        for (field, expected, ok, values) in [
            ("gain", "positive numbers", (|g| g > 0.0) as fn(f64) -> bool, &self.gain),
            ("dark_j", "finite numbers", |_| true, &self.dark_j),
        ] {
            if let Some(&found) = values.iter().find(|v| !(v.is_finite() && ok(**v))) {
                return Err(Key::new(field).refuse(expected, found).into());
            }
        }
        Ok(())
    }

    /// Undoes gain and dark level in place and masks the bad pixels. A pixel at or above `saturation_j` keeps a
    /// value at or above it: what it lost cannot be restored. A frame of another shape is left as it is, for the
    /// estimator to refuse.
    pub fn correct(&self, frame: &mut Frame, saturation_j: Option<f64>) {
        if frame.pixels.dim() != self.gain.dim() {
            return;
        }
        let ceiling = saturation_j.unwrap_or(f64::INFINITY);
        Zip::from(&mut frame.pixels)
            .and(&self.gain)
            .and(&self.dark_j)
            .for_each(|y, &gain, &dark| {
                let corrected = (*y - dark) / gain;
                // Division by a low gain could raise an unsaturated pixel to the saturation level.
                *y = if *y >= ceiling {
                    corrected.max(ceiling)
                } else {
                    corrected.min(ceiling.next_down())
                };
            });
        if self.bad.iter().any(|&b| b) {
            match &mut frame.masked {
                Some(masked) if masked.dim() == self.bad.dim() => {
                    Zip::from(masked).and(&self.bad).for_each(|m, &b| *m |= b);
                }
                masked => *masked = Some(self.bad.clone()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(pixels: Array2<f64>) -> Frame {
        Frame {
            index: 0,
            time: jiff::Timestamp::UNIX_EPOCH,
            pixels,
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        }
    }

    #[test]
    fn correction_undoes_gain_and_dark_and_keeps_saturation() {
        let mut maps = PixelMaps::ideal((1, 3));
        maps.gain = ndarray::array![[2.0, 0.5, 2.0]];
        maps.dark_j = ndarray::array![[1.0, -1.0, 0.0]];
        maps.bad[[0, 1]] = true;
        let mut f = frame(ndarray::array![[7.0, 1.5, 10.0]]);
        maps.correct(&mut f, Some(10.0));
        assert_eq!(f.pixels, ndarray::array![[3.0, 5.0, 10.0]]);
        assert_eq!(f.masked, Some(ndarray::array![[false, true, false]]));
    }
}
