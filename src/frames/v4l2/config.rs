//! `[source.v4l2]`: the settings requested from a camera.

use serde::{Deserialize, Serialize};

use super::image::{PixelFormat, Region};
use crate::frames::Error;
use crate::toml_file::Key;

/// `[source.v4l2]`. Settings that are left out stay as the driver has them.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// "GREY", "Y10", "Y12", "Y16" or "Y16_BE"; the deepest on offer when left out.
    pub pixel_format: Option<PixelFormat>,
    /// [width, height] of the camera's image.
    pub size: Option<[u32; 2]>,
    /// [x, y, width, height] of the part that is the photodetector array, in camera pixels; the whole image when
    /// left out. Its size must be a whole multiple of `optics.pixels`: blocks of camera pixels are summed.
    pub roi: Option<[usize; 4]>,
    /// Mirror x, for a camera whose first column is x_max.
    pub flip_x: bool,
    /// Mirror y, for a camera whose first row is y_max.
    pub flip_y: bool,
    /// Exposure time; automatic exposure is switched off.
    pub exposure_us: Option<f64>,
    /// Gain in the driver's own unit; automatic gain is switched off.
    pub gain: Option<i64>,
    /// A camera pixel at or above this count is saturated; the format's largest count when left out.
    pub saturation_counts: Option<u16>,
    /// Frames to skip after each start, until the settings take effect.
    pub settle_frames: u32,
    /// Without a usable frame for this long the device is reopened, s.
    pub stall_s: f64,
}

impl Config {
    /// Checks every number. What the driver has to grant is checked when the device is opened.
    pub fn validate(&self) -> Result<(), Error> {
        let key = Key::new("source.v4l2");
        if let Some(exposure) = self.exposure_us {
            key.at("exposure_us").within(
                exposure,
                1.0..=1e8,
                "V4L2 counts in 100 µs; no camera exposes for minutes",
            )?;
        }
        let reason = "more would skip minutes of frames";
        key.at("settle_frames")
            .within(self.settle_frames.into(), 0.0..=10_000.0, reason)?;
        key.at("stall_s").within(
            self.stall_s,
            0.1..=3600.0,
            "a stalled camera is reopened within the hour",
        )?;
        if let Some(size) = self.size.filter(|size| size.contains(&0)) {
            return Err(key.at("size").refuse("a width and a height of at least 1", size).into());
        }
        if self.saturation_counts == Some(0) {
            return Err(key.at("saturation_counts").refuse("1 to 65535", 0).into());
        }
        Ok(())
    }

    pub(super) fn region(&self) -> Option<Region> {
        self.roi.map(|[x, y, width, height]| Region { x, y, width, height })
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            pixel_format: None,
            size: None,
            roi: None,
            flip_x: false,
            flip_y: false,
            exposure_us: None,
            gain: None,
            saturation_counts: None,
            settle_frames: 2,
            stall_s: 3.0,
        }
    }
}
