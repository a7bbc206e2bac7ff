//! Validation: which pixels of a frame may be used, in units of the noise.

use crate::estimate::error::Error;
use crate::frame::Frame;
use crate::optics::Camera;

/// A pixel of this many standard deviations of the noise is no measurement.
const OVERFLOWS: f64 = 1e100;

/// A frame divided by the noise, with its unusable pixels listed and filled in.
#[derive(Clone, Default)]
pub(crate) struct Screened {
    /// (Ny, Nx) row-major. Unusable pixels hold the mean of their usable neighbours, or `ceiling`; a fit must not
    /// look at them.
    pub pixels: Vec<f64>,
    pub bad: Vec<Bad>,
    pub is_bad: Vec<bool>,
    pub saturated: usize,
}

/// A pixel that carries no usable value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Bad {
    pub x: usize,
    pub y: usize,
    pub is_saturated: bool,
}

impl Screened {
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
        self.bad.clear();
        self.is_bad.clear();
        self.saturated = 0;
        let (mut nan, mut masked) = (0, 0);
        let scale = 1.0 / camera.noise_std_j;
        let ceiling = camera.saturation_j.unwrap_or(f64::INFINITY);
        self.pixels.extend(frame.pixels.iter().map(|value| value * scale));
        self.is_bad.resize(self.pixels.len(), false);
        let is_sound = |value: f64| (value * scale).abs() < OVERFLOWS && value < ceiling;
        // Most frames are: no branch, so that the compiler takes several pixels at a time.
        if frame.masked.is_none() && frame.pixels.iter().fold(true, |all, &value| all & is_sound(value)) {
            return Ok(());
        }
        for (k, ((y, x), &value)) in frame.pixels.indexed_iter().enumerate() {
            let is_masked = frame.masked.as_ref().is_some_and(|m| m.get((y, x)) == Some(&true));
            if is_sound(value) && !is_masked {
                continue;
            }
            let is_saturated = value >= ceiling;
            // Squares of such a value leave the range of f64: it is as little light as ∞.
            nan += usize::from(!((value * scale).abs() < OVERFLOWS));
            masked += usize::from(is_masked);
            self.saturated += usize::from(is_saturated);
            self.bad.push(Bad { x, y, is_saturated });
            self.is_bad[k] = true;
            self.pixels[k] = ceiling * scale;
        }
        if self.bad.len() == self.pixels.len() {
            return Err(Error::NoUsablePixel {
                total: self.pixels.len(),
                nan,
                saturated: self.saturated,
                masked,
            });
        }
        self.fill(nx, ny);
        Ok(())
    }

    /// Marks one more pixel as unusable. The caller fills it.
    pub fn reject(&mut self, x: usize, y: usize, nx: usize) {
        if !std::mem::replace(&mut self.is_bad[y * nx + x], true) {
            self.bad.push(Bad {
                x,
                y,
                is_saturated: false,
            });
        }
    }

    /// Gives every unusable pixel that is not saturated the mean of the usable ones nearest to it.
    fn fill(&mut self, nx: usize, ny: usize) {
        for bad in &self.bad {
            if bad.is_saturated && self.pixels[bad.y * nx + bad.x].is_finite() {
                continue;
            }
            let mut radius = 1;
            self.pixels[bad.y * nx + bad.x] = loop {
                let (mut sum, mut count) = (0.0, 0);
                for y in bad.y.saturating_sub(radius)..=(bad.y + radius).min(ny - 1) {
                    for x in bad.x.saturating_sub(radius)..=(bad.x + radius).min(nx - 1) {
                        if !self.is_bad[y * nx + x] {
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
