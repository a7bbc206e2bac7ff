//! `[optics]` of a config or scene.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::calibration::Calibration;
use super::camera::{Axis, Camera, SpotError};
use super::distortion::Distortion;
use super::error::Error;
use crate::toml_file::Key;

/// Share of its level by which a saturated pixel may lie below it: counts times joules per count are rounded, to single precision in some
/// recordings. A sixteenth of a count of 16 bits.
const ROUNDING: f64 = 1e-6;

/// `[optics]` of a config or scene. What is left out takes the value of the paper's scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub altitude_m: f64,
    pub lens_radius_m: f64,
    /// Lens-to-sensor distance z.
    pub plane_distance_m: f64,
    /// [Nx, Ny].
    pub pixels: [usize; 2],
    pub sensor_size_m: [f64; 2],
    /// σ_eff. Leave out when `blur` is given.
    pub spot_sigma_m: Option<f64>,
    pub blur: Option<BlurConfig>,
    pub noise_std_j: f64,
    /// Scale of integer frames.
    pub joules_per_count: Option<f64>,
    /// A pixel at or above this is saturated and carries no more than that.
    pub saturation_j: Option<f64>,
    /// Share of a spot's light by which its shape may differ from the model. Left out: the calibration's figure, and without one
    /// what the frames show.
    pub spot_error: Option<f64>,
    /// A file written by `oapwatch calibrate`.
    pub calibration: Option<PathBuf>,
    /// The content of that file, filled in by the reader of the config.
    #[serde(skip)]
    pub calibrated: Option<Calibration>,
}

/// The blur budget σ_eff² = σ_def² + σ_diff² + σ_sens².
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlurConfig {
    pub focal_length_m: f64,
    pub wavelength_m: f64,
    pub sensor_sigma_m: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            altitude_m: 300.0,
            lens_radius_m: 0.05,
            plane_distance_m: 0.036,
            pixels: [64, 64],
            sensor_size_m: [0.03, 0.03],
            spot_sigma_m: None,
            blur: None,
            noise_std_j: 1e-6,
            joules_per_count: None,
            saturation_j: None,
            spot_error: None,
            calibration: None,
            calibrated: None,
        }
    }
}

impl Config {
    /// σ_eff when neither `spot_sigma_m` nor `blur` is given, m.
    pub const DEFAULT_SPOT_SIGMA_M: f64 = 1e-3;

    /// Refuses values that no device has, which [`Config::camera`] would accept: they are slips, such as millimetres for metres.
    pub fn validate(&self) -> Result<(), Error> {
        let key = Key::new("optics");
        let camera = Self {
            calibration: None,
            calibrated: None,
            ..self.clone()
        }
        .camera()?;
        let within = |name, value, range, reason| key.at(name).within(value, range, reason).map(drop);
        within(
            "altitude_m",
            camera.altitude_m,
            0.01..=1e5,
            "from a laboratory bench to the stratosphere",
        )?;
        within(
            "lens_radius_m",
            camera.lens_radius_m,
            1e-5..=10.0,
            "from a microlens to the largest telescope",
        )?;
        within(
            "plane_distance_m",
            camera.plane_distance_m,
            1e-5..=100.0,
            "from a microlens to the longest telescope",
        )?;
        for size in self.sensor_size_m {
            within(
                "sensor_size_m",
                size,
                1e-5..=10.0,
                "from a few pixels to the largest mosaic",
            )?;
        }
        let pitch = camera.x.pitch_m.min(camera.y.pitch_m);
        let widest = 2.0 * camera.x.half_width().max(camera.y.half_width());
        let name = if self.blur.is_some() { "blur" } else { "spot_sigma_m" };
        let reason = "from a thousandth of a pixel to the sensor's width, beyond which a spot has no position";
        within(name, camera.spot_sigma_m, 1e-3 * pitch..=widest, reason)?;
        if let Some(blur) = &self.blur {
            within(
                "blur.focal_length_m",
                blur.focal_length_m,
                1e-5..=100.0,
                "from a microlens to the longest telescope",
            )?;
            within(
                "blur.wavelength_m",
                blur.wavelength_m,
                1e-8..=1e-3,
                "from the ultraviolet to terahertz waves",
            )?;
        }
        let energy = "joules per pixel and exposure: from below one photon to far above any array";
        within("noise_std_j", camera.noise_std_j, 1e-30..=1e6, energy)?;
        if let Some(scale) = self.joules_per_count {
            within("joules_per_count", scale, 1e-30..=1e6, energy)?;
        }
        if let Some(level) = self.saturation_j {
            within(
                "saturation_j",
                level,
                camera.noise_std_j..=1e12,
                "from noise_std_j on; below it every pixel is saturated",
            )?;
        }
        Ok(())
    }

    /// Checks every field and resolves the blur budget.
    pub fn camera(&self) -> Result<Camera, Error> {
        let key = Key::new("optics");
        let positive = |name, value| key.at(name).positive(value);
        for n in self.pixels {
            if n == 0 || n > 4096 {
                return Err(key.at("pixels").refuse("1 to 4096 a side", self.pixels).into());
            }
        }
        let axis = |k: usize| -> Result<Axis, Error> {
            let size = positive("sensor_size_m", self.sensor_size_m[k])?;
            Ok(Axis::centred(self.pixels[k], size))
        };
        let lens_radius_m = positive("lens_radius_m", self.lens_radius_m)?;
        let plane_distance_m = positive("plane_distance_m", self.plane_distance_m)?;
        let spot_sigma_m = match (&self.spot_sigma_m, &self.blur) {
            (Some(_), Some(_)) => return Err(Error::TwoBlurs),
            (Some(sigma), None) => positive("spot_sigma_m", *sigma)?,
            (None, Some(blur)) => {
                let f = positive("blur.focal_length_m", blur.focal_length_m)?;
                let wavelength = positive("blur.wavelength_m", blur.wavelength_m)?;
                let sensor = blur.sensor_sigma_m;
                key.at("blur.sensor_sigma_m").non_negative(sensor)?;
                if plane_distance_m > f {
                    let expected = "at most blur.focal_length_m";
                    return Err(key.at("plane_distance_m").refuse(expected, plane_distance_m).into());
                }
                super::blur::spot_sigma(lens_radius_m, plane_distance_m, f, wavelength, sensor)
            }
            (None, None) => Self::DEFAULT_SPOT_SIGMA_M,
        };
        if let Some(scale) = self.joules_per_count {
            positive("joules_per_count", scale)?;
        }
        if let Some(level) = self.saturation_j {
            positive("saturation_j", level)?;
        }
        if let Some(share) = self.spot_error {
            let reason = "the share of a spot's light; beyond half of it there is no model";
            key.at("spot_error")
                .within(share, 0.0..=Camera::LARGEST_SPOT_ERROR, reason)?;
        }
        let camera = Camera {
            altitude_m: positive("altitude_m", self.altitude_m)?,
            lens_radius_m,
            plane_distance_m,
            x: axis(0)?,
            y: axis(1)?,
            spot_sigma_m,
            noise_std_j: positive("noise_std_j", self.noise_std_j)?,
            quantum_j: None,
            joules_per_count: self.joules_per_count,
            saturation_j: self.saturation_j.map(|level| level * (1.0 - ROUNDING)),
            spot_growth: 0.0,
            spot_shape: None,
            spot_error: self.spot_error.map_or(SpotError::AtLeast(0.0), SpotError::Fixed),
            distortion: Distortion::default(),
            pixels: None,
        };
        match (&self.calibrated, &self.calibration) {
            (Some(calibration), _) => Ok(calibration.applied_to(&camera)?),
            (None, Some(path)) => Err(Error::CalibrationNotRead(path.clone())),
            (None, None) => Ok(camera),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_saturated_pixel_is_one_however_its_joules_are_rounded() {
        for (joules_per_count, level) in [(3e-8, 0.00012285), (1.7e-4 / 4095.0, 1.7e-4)] {
            let config = Config {
                saturation_j: Some(level),
                ..Config::default()
            };
            let limit = config.camera().expect("valid").saturation_limit_j();
            let clipped = 4095.0 * joules_per_count;
            assert!(clipped >= limit && f64::from(clipped as f32) >= limit, "{level}");
            assert!(4094.0 * joules_per_count < limit);
        }
    }
}
