//! What a calibration knows about one device beyond its data sheet.

use std::sync::Arc;

use ndarray::{Array2, Zip};

use super::{Camera, Distortion};
use crate::frame::Frame;

/// One device's measured geometry, spot and pixels; written by `oapwatch calibrate`.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    pub distortion: Distortion,
    /// σ_eff on the optical axis, m.
    pub spot_sigma_m: f64,
    /// Relative growth of σ_eff from the optical axis to the sensor's corner.
    pub spot_growth: f64,
    pub noise_std_j: f64,
    pub pixels: Option<Arc<PixelMaps>>,
}

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

/// Why a calibration does not fit a camera.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    #[error("{map} map is {found_x} × {found_y} pixels, the camera has {expected_x} × {expected_y}")]
    WrongShape {
        map: &'static str,
        expected_x: usize,
        expected_y: usize,
        found_x: usize,
        found_y: usize,
    },
    #[error("{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error("the distortion folds back within the sensor: no direction belongs to some of its points")]
    NotInvertible,
}

impl Calibration {
    /// What an uncalibrated camera assumes.
    pub fn of(camera: &Camera) -> Self {
        Self {
            distortion: camera.distortion,
            spot_sigma_m: camera.spot_sigma_m,
            spot_growth: camera.spot_growth,
            noise_std_j: camera.noise_std_j,
            pixels: camera.pixels.clone(),
        }
    }

    /// The camera with this calibration in place of its data sheet.
    pub fn applied_to(&self, camera: &Camera) -> Result<Camera, CalibrationError> {
        self.check(camera)?;
        Ok(Camera {
            distortion: self.distortion,
            spot_sigma_m: self.spot_sigma_m,
            spot_growth: self.spot_growth,
            noise_std_j: self.noise_std_j,
            pixels: self.pixels.clone(),
            ..camera.clone()
        })
    }

    fn check(&self, camera: &Camera) -> Result<(), CalibrationError> {
        let within = |field, expected, found: f64, ok: bool| {
            if found.is_finite() && ok {
                Ok(())
            } else {
                Err(CalibrationError::OutOfRange { field, expected, found })
            }
        };
        let d = &self.distortion;
        within("focal_scale", "a positive number", d.focal_scale, d.focal_scale > 0.0)?;
        for p in d.parameters() {
            within("distortion", "finite numbers", p, true)?;
        }
        within(
            "spot_sigma_m",
            "a positive number",
            self.spot_sigma_m,
            self.spot_sigma_m > 0.0,
        )?;
        within("spot_growth", "more than -1", self.spot_growth, self.spot_growth > -1.0)?;
        within(
            "noise_std_j",
            "a positive number",
            self.noise_std_j,
            self.noise_std_j > 0.0,
        )?;
        // Emitters are also fitted a little outside the sensor; how the lens bends far out there is a guess anyway.
        let corner = |k: usize| {
            let half = [camera.x.half_width(), camera.y.half_width()][k];
            half + (2.0 * self.spot_sigma_m).min(0.1 * half) + d.principal_point_m[k].abs()
        };
        let r_max = corner(0).hypot(corner(1)) / (camera.plane_distance_m * d.focal_scale);
        if !d.is_invertible(r_max) {
            return Err(CalibrationError::NotInvertible);
        }
        self.pixels.as_ref().map_or(Ok(()), |maps| maps.check(camera.shape()))
    }
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

    fn check(&self, (ny, nx): (usize, usize)) -> Result<(), CalibrationError> {
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
                return Err(CalibrationError::OutOfRange { field, expected, found });
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
                // Just below the ceiling a low gain could lift a sound pixel to it.
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

    #[test]
    fn maps_of_another_shape_are_refused() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let calibration = Calibration {
            pixels: Some(Arc::new(PixelMaps::ideal((63, 64)))),
            ..Calibration::of(&camera)
        };
        let error = calibration.applied_to(&camera).unwrap_err();
        assert_eq!(error.to_string(), "gain map is 64 × 63 pixels, the camera has 64 × 64");
    }
}
