//! The calibration of one device: geometry, spot, noise and pixel maps.

use std::sync::Arc;

use super::camera::{Camera, SpotError};
use super::distortion::Distortion;
use super::error::CalibrationError;
use super::pixel_maps::PixelMaps;
use super::spot::SpotShape;
use crate::toml_file::Key;

/// One device's measured geometry, spot and pixels; written by `oapwatch calibrate`.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    pub distortion: Distortion,
    /// σ_eff on the optical axis, m.
    pub spot_sigma_m: f64,
    /// Relative growth of σ_eff from the optical axis to the sensor's corner.
    pub spot_growth: f64,
    /// The spot's shape where one was learned.
    pub spot_shape: Option<Arc<SpotShape>>,
    /// Measured share of a spot's light by which it differs from its model.
    pub spot_error: Option<f64>,
    pub noise_std_j: f64,
    /// Growth of the variance with the light, J.
    pub quantum_j: Option<f64>,
    pub pixels: Option<Arc<PixelMaps>>,
}

impl Calibration {
    /// The calibration that an uncalibrated camera assumes.
    pub fn of(camera: &Camera) -> Self {
        Self {
            distortion: camera.distortion,
            spot_sigma_m: camera.spot_sigma_m,
            spot_growth: camera.spot_growth,
            spot_shape: camera.spot_shape.clone(),
            spot_error: Some(camera.spot_error.least()).filter(|share| *share > 0.0),
            noise_std_j: camera.noise_std_j,
            quantum_j: camera.quantum_j,
            pixels: camera.pixels.clone(),
        }
    }

    /// The camera with this calibration in place of its data sheet.
    pub fn applied_to(&self, camera: &Camera) -> Result<Camera, CalibrationError> {
        self.check(camera)?;
        let (spot_shape, spot_error) = match camera.spot_error {
            SpotError::AtLeast(_) => (
                self.spot_shape.clone(),
                SpotError::AtLeast(self.spot_error.unwrap_or_default()),
            ),
            fixed @ SpotError::Fixed(_) => {
                let shape = self.spot_shape.as_deref().cloned();
                (shape.map(|shape| Arc::new(shape.with_beyond(None))), fixed)
            }
        };
        Ok(Camera {
            distortion: self.distortion,
            spot_sigma_m: self.spot_sigma_m,
            spot_growth: self.spot_growth,
            spot_shape,
            spot_error,
            noise_std_j: self.noise_std_j,
            quantum_j: self.quantum_j,
            pixels: self.pixels.clone(),
            ..camera.clone()
        })
    }

    fn check(&self, camera: &Camera) -> Result<(), CalibrationError> {
        let within = |field, expected, found: f64, ok: bool| {
            if found.is_finite() && ok {
                Ok(())
            } else {
                Err(Key::new(field).refuse(expected, found))
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
        let error = self.spot_error.unwrap_or_default();
        let range = "0 to 0.5, the share of a spot's light";
        within(
            "spot.error",
            range,
            error,
            (0.0..=Camera::LARGEST_SPOT_ERROR).contains(&error),
        )?;
        within(
            "noise_std_j",
            "a positive number",
            self.noise_std_j,
            self.noise_std_j > 0.0,
        )?;
        let quantum = self.quantum_j.unwrap_or_default();
        within("quantum_j", "0 or more", quantum, quantum >= 0.0)?;
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

#[cfg(test)]
mod tests {
    use super::*;

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
