//! `[source.v4l2]`: the settings requested from a camera.

use serde::{Deserialize, Serialize};

use super::format::PixelFormat;
use super::image::{Bayer, Decoding, Region};
use super::response::{Response, Transfer};
use crate::frames::Error;
use crate::toml_file::Key;

/// `[source.v4l2]`. Settings that are left out stay as the driver has them.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A name that `oapwatch devices` lists; the best on offer when left out.
    pub pixel_format: Option<PixelFormat>,
    /// [width, height] of the camera's image. When left out: with `roi` as the camera stands, otherwise the best size that
    /// is a whole multiple of `optics.pixels`, or as the camera stands where it lists none.
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
    /// Our own control of the exposure, `exposure_us` at most: the brightest beam stays below saturation, and beside one that dazzles short
    /// and long exposures are taken in turns. Energies are those of `exposure_us`.
    pub auto_exposure: bool,
    /// Gain in the driver's own unit; automatic gain is switched off.
    pub gain: Option<i64>,
    /// A camera pixel at or above this count is saturated; the format's largest count when left out.
    pub saturation_counts: Option<u16>,
    /// Counts of a camera pixel without light, taken off each (after `transfer`).
    pub black_counts: f64,
    /// Pixels behind a Bayer filter: summed 2 × 2, or each a sample.
    pub bayer: Bayer,
    /// Curve of a video signal's counts, undone before pixels are summed.
    pub transfer: Transfer,
    /// A video signal with black at 16 and white at 235 of 255.
    pub limited_range: bool,
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
        if self.auto_exposure && self.exposure_us.is_none() {
            let expected = "a number of µs with auto_exposure = true: the longest exposure, to which energies refer";
            return Err(key.at("exposure_us").refuse(expected, "nothing").into());
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
        key.at("black_counts")
            .within(self.black_counts, 0.0..=65535.0, "a level that 16 bits hold")?;
        if self.saturation_counts == Some(0) {
            return Err(key.at("saturation_counts").refuse("1 to 65535", 0).into());
        }
        Ok(())
    }

    /// How an image becomes an array of (Ny, Nx) pixels.
    pub(super) fn decoding(&self, shape: (usize, usize)) -> Decoding {
        Decoding {
            region: self.region(),
            shape,
            flip: [self.flip_x, self.flip_y],
            saturation: self.saturation_counts,
            response: Response {
                transfer: self.transfer,
                limited_range: self.limited_range,
            },
            black: self.black_counts,
            bayer: self.bayer,
        }
    }

    fn region(&self) -> Option<Region> {
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
            auto_exposure: false,
            gain: None,
            saturation_counts: None,
            black_counts: 0.0,
            bayer: Bayer::default(),
            transfer: Transfer::default(),
            limited_range: false,
            settle_frames: 2,
            stall_s: 3.0,
        }
    }
}
