//! Validates a frame: divides it by the noise, lists the pixels that cannot be used and interpolates over them.

use crate::estimate::error::Error;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::frame::Frame;
use crate::optics::{Camera, DisplacedSpots};
use crate::stats::is_cut_off;

/// The share of standard normal noise below −1.
const BELOW_ONE: f64 = 0.1587;

/// Values of this many standard deviations or more count as non-finite: their squares approach the range of f64.
const OVERFLOWS: f64 = 1e100;

/// Whether a fit may use a pixel's value, J: finite in units of the noise, 1/`scale`, and below saturation at `ceiling`.
#[inline(always)]
pub(crate) fn is_usable(value: f64, scale: f64, ceiling: f64) -> bool {
    (value * scale).abs() < OVERFLOWS && value < ceiling
}

/// A frame in units of the noise's standard deviation, with its masked pixels listed and filled in.
#[derive(Clone, Default)]
pub(crate) struct PreprocessedFrame {
    /// (Ny, Nx) row-major. Masked pixels hold the mean of their usable neighbours, or `ceiling`; a fit must not
    /// use them.
    pub pixels: Vec<f64>,
    pub flagged: Vec<FlaggedPixel>,
    pub is_masked: Vec<bool>,
    pub saturated: usize,
    /// How the noise grows with the light, where that is known before the frame is searched.
    pub variance: VarianceFunction,
    /// How spots are smeared by motion, for the frames that are loaded from now on.
    pub smear: Option<DisplacedSpots>,
    /// Emitters beyond the frame that cast a halo into it, for the frames that are loaded from now on.
    pub beyond: Vec<PointSource>,
}

/// A pixel that must not be used, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FlaggedPixel {
    pub x: usize,
    pub y: usize,
    pub is_saturated: bool,
    /// It holds light that is searched for elsewhere: the emitters here lack nothing.
    pub is_foreign: bool,
}

impl PreprocessedFrame {
    /// Checks and normalises a frame.
    pub fn load(&mut self, frame: &Frame, camera: &Camera) -> Result<(), Error> {
        let (ny, nx) = frame.pixels.dim();
        if (ny, nx) != camera.shape() {
            return Err(Error::WrongShape {
                expected_x: camera.x.n,
                expected_y: camera.y.n,
                found_x: nx,
                found_y: ny,
            });
        }
        self.pixels.clear();
        self.flagged.clear();
        self.is_masked.clear();
        self.saturated = 0;
        let (mut nan, mut masked) = (0, 0);
        let scale = 1.0 / camera.noise_std_j;
        let ceiling = camera.saturation_limit_j();
        self.pixels.extend(frame.pixels.iter().map(|value| value * scale));
        self.is_masked.resize(self.pixels.len(), false);
        let is_sound = |value: f64| is_usable(value, scale, ceiling);
        // The common case: without branches, so that the loop is vectorised.
        if frame.masked.is_none() && frame.pixels.iter().fold(true, |all, &value| all & is_sound(value)) {
            return Ok(());
        }
        for (k, ((y, x), &value)) in frame.pixels.indexed_iter().enumerate() {
            let is_masked = frame.masked.as_ref().is_some_and(|m| m.get((y, x)) == Some(&true));
            if is_sound(value) && !is_masked {
                continue;
            }
            let is_saturated = value >= ceiling;
            // Values whose square overflows count as non-finite.
            nan += usize::from(!((value * scale).abs() < OVERFLOWS));
            masked += usize::from(is_masked);
            self.saturated += usize::from(is_saturated);
            self.flagged.push(FlaggedPixel {
                x,
                y,
                is_saturated,
                is_foreign: false,
            });
            self.is_masked[k] = true;
            self.pixels[k] = ceiling * scale;
        }
        if self.flagged.len() == self.pixels.len() {
            return Err(Error::NoUsablePixel {
                total: self.pixels.len(),
                nan,
                saturated: self.saturated,
                masked,
            });
        }
        self.interpolate_masked(nx, ny);
        Ok(())
    }

    /// Share of pixels at or above saturation.
    pub fn saturated_share(&self) -> f64 {
        self.saturated as f64 / self.pixels.len() as f64
    }

    /// Whether the camera cuts off what is darker than its black level: half of the noise then lies on the frame's lowest value.
    pub fn is_clipped(&self) -> bool {
        let usable = self.pixels.iter().zip(&self.is_masked).filter(|(_, bad)| !**bad);
        is_cut_off(usable.map(|(p, _)| *p))
    }

    /// Whether the dark parts are brighter or darker than the noise. A fainter background shows in the residual.
    pub fn has_visible_background(&self) -> bool {
        let (mut usable, mut low) = (0.0, 0.0);
        for (p, _) in self.pixels.iter().zip(&self.is_masked).filter(|(_, bad)| !**bad) {
            usable += 1.0;
            low += f64::from(u8::from(*p < -1.0));
        }
        is_background_visible(usable, low)
    }

    /// Masks one more pixel; the caller fills it.
    pub fn mask(&mut self, x: usize, y: usize, nx: usize) {
        if !std::mem::replace(&mut self.is_masked[y * nx + x], true) {
            self.flagged.push(FlaggedPixel {
                x,
                y,
                is_saturated: false,
                is_foreign: false,
            });
        }
    }

    /// Masks a pixel that holds light of emitters that are searched for elsewhere.
    pub fn exclude(&mut self, x: usize, y: usize, nx: usize) {
        let k = y * nx + x;
        if !std::mem::replace(&mut self.is_masked[k], true) {
            self.pixels[k] = 0.0;
            self.flagged.push(FlaggedPixel {
                x,
                y,
                is_saturated: false,
                is_foreign: true,
            });
        }
    }

    /// Gives every masked pixel that is not saturated the mean of the nearest usable ones.
    fn interpolate_masked(&mut self, nx: usize, ny: usize) {
        for bad in &self.flagged {
            if bad.is_saturated && self.pixels[bad.y * nx + bad.x].is_finite() {
                continue;
            }
            let mut radius = 1;
            self.pixels[bad.y * nx + bad.x] = loop {
                let (mut sum, mut count) = (0.0, 0);
                for y in bad.y.saturating_sub(radius)..=(bad.y + radius).min(ny - 1) {
                    for x in bad.x.saturating_sub(radius)..=(bad.x + radius).min(nx - 1) {
                        if !self.is_masked[y * nx + x] {
                            sum += self.pixels[y * nx + x];
                            count += 1;
                        }
                    }
                }
                if count > 0 {
                    break sum / count as f64;
                }
                radius *= 2;
            };
        }
    }
}

/// The same by the number of usable pixels and of those below −1.
pub(crate) fn is_background_visible(usable: f64, low: f64) -> bool {
    let expected = BELOW_ONE * usable;
    low < 0.25 * expected - 5.0 || low > expected + 5.0 * expected.sqrt()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn counts_that_are_cut_off_at_the_black_level_are_told_from_coarse_ones() {
        let frame = |step: f64, least: f64| {
            let mut rng = ChaCha8Rng::seed_from_u64(3);
            let mut noise = || -> f64 { StandardNormal.sample(&mut rng) };
            let pixels: Vec<f64> = (0..4096).map(|_| (noise() / step).round().max(least) * step).collect();
            PreprocessedFrame {
                is_masked: vec![false; pixels.len()],
                pixels,
                ..PreprocessedFrame::default()
            }
        };
        assert!(!frame(1e-9, f64::NEG_INFINITY).is_clipped() && !frame(0.5, f64::NEG_INFINITY).is_clipped());
        assert!(frame(0.25, 0.0).is_clipped() && frame(0.25, -4.0).is_clipped());
    }
}
