//! Decodes a camera image into the photodetector array: pure functions.

use std::sync::Arc;

use ndarray::Array2;
use serde::{Deserialize, Serialize};

use super::format::{Encoding, Light, PixelFormat};
use super::response::Response;
use super::{jpeg, unpack};

/// Part of a camera image, in camera pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
}

/// What becomes of the pixels behind a Bayer filter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Bayer {
    /// Sums of 2 × 2, one of each colour and two green: the same for light of every wavelength.
    #[default]
    Binned,
    /// Each pixel as a sample of its own: twice as fine. Right for near infrared, to which the colours are alike, and after a
    /// calibration with the light in use.
    Sites,
}

/// How a camera image becomes the array: a region, cut into Ny × Nx equal blocks whose counts are summed.
#[derive(Clone, Debug)]
pub struct Layout {
    granted: Granted,
    region: Region,
    shape: (usize, usize),
    flip: [bool; 2],
    /// A camera pixel at or above this count is saturated.
    saturation: u16,
    /// Counts in proportion to light, where the camera's are not.
    linear: Option<Arc<[f64]>>,
    /// Of an array pixel without light.
    black: f64,
}

/// How to cut and count an image.
#[derive(Clone, Copy, Debug, Default)]
pub struct Decoding {
    /// The whole image when left out.
    pub region: Option<Region>,
    /// The array's (Ny, Nx).
    pub shape: (usize, usize),
    /// Mirrors x and y, for a camera whose first column or row is not the array's minimum.
    pub flip: [bool; 2],
    /// White of the format when left out.
    pub saturation: Option<u16>,
    pub response: Response,
    /// Counts of a camera pixel without light, taken off.
    pub black: f64,
    pub bayer: Bayer,
}

/// The array's counts, shape (Ny, Nx).
#[derive(Clone, Debug, PartialEq)]
pub struct Counts {
    pub counts: Array2<f64>,
    /// Where at least one of the camera pixels was saturated.
    pub saturated: Option<Array2<bool>>,
    /// The brightest camera pixel, as a share of saturation.
    pub brightest: f64,
}

/// Why an image gives no counts.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    #[error("{found} bytes, expected {needed}")]
    Short { found: usize, needed: usize },
    #[error("{0}")]
    Jpeg(String),
}

/// Why a camera image cannot become the array.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    #[error("source.v4l2.roi: {width} × {height} at ({x}, {y}) reaches past the camera's image of {of_x} × {of_y}")]
    OutsideImage {
        x: usize,
        y: usize,
        width: usize,
        height: usize,
        of_x: usize,
        of_y: usize,
    },
    #[error(
        "a region of {width} × {height} camera pixels is not a whole multiple of the array's {nx} × {ny}: set source.v4l2.roi"
    )]
    NotDivisible {
        width: usize,
        height: usize,
        nx: usize,
        ny: usize,
    },
    #[error(
        "a Bayer image is summed 2 × 2 by 2 × 2, and {bin_x} × {bin_y} camera pixels make one of the array: set an even multiple in \
         source.v4l2.roi, or source.v4l2.bayer = \"sites\""
    )]
    SplitsBayer { bin_x: usize, bin_y: usize },
    #[error("the driver reports rows of {stride} bytes for {width} pixels, which take {needed}")]
    Stride { stride: usize, width: usize, needed: usize },
}

/// The granted image format, as far as decoding needs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Granted {
    pub format: PixelFormat,
    pub width: usize,
    pub height: usize,
    /// Bytes from one row to the next; 0 where the driver leaves it open.
    pub stride: usize,
}

impl Layout {
    /// # Errors
    /// The image cannot be cut as asked.
    pub fn new(granted: Granted, decoding: &Decoding) -> Result<Self, LayoutError> {
        let Granted {
            format, width, height, ..
        } = granted;
        let needed = format.encoding().bytes_for(width);
        // A JPEG image has no rows of its own.
        let stride = match granted.stride {
            stride if stride == 0 || format.is_compressed() => needed,
            stride => stride,
        };
        if stride < needed {
            return Err(LayoutError::Stride { stride, width, needed });
        }
        let region = decoding.region.unwrap_or(Region {
            x: 0,
            y: 0,
            width,
            height,
        });
        let Region {
            x,
            y,
            width: w,
            height: h,
        } = region;
        let inside = |start: usize, size: usize, of: usize| start.checked_add(size).is_some_and(|end| end <= of);
        if !inside(x, w, width) || !inside(y, h, height) {
            return Err(LayoutError::OutsideImage {
                x,
                y,
                width: w,
                height: h,
                of_x: width,
                of_y: height,
            });
        }
        let (ny, nx) = decoding.shape;
        if w == 0 || h == 0 || w % nx != 0 || h % ny != 0 {
            return Err(LayoutError::NotDivisible {
                width: w,
                height: h,
                nx,
                ny,
            });
        }
        // Any 2 × 2 pixels hold each colour, wherever they begin.
        let (bin_x, bin_y) = (w / nx, h / ny);
        if format.light() == Light::Bayer && decoding.bayer == Bayer::Binned && (bin_x % 2 != 0 || bin_y % 2 != 0) {
            return Err(LayoutError::SplitsBayer { bin_x, bin_y });
        }
        let full_scale = format.full_scale();
        let (_, white) = decoding.response.range(full_scale);
        Ok(Self {
            granted: Granted { stride, ..granted },
            region,
            shape: decoding.shape,
            flip: decoding.flip,
            saturation: decoding.saturation.unwrap_or(white as u16).min(full_scale),
            linear: decoding.response.table(full_scale).map(Arc::from),
            black: decoding.black * (bin_x * bin_y) as f64,
        })
    }

    /// Bytes that an image must have at least.
    pub fn bytes_needed(&self) -> usize {
        let Region { x, y, width, height } = self.region;
        let encoding = self.granted.format.encoding();
        (y + height - 1) * self.granted.stride + encoding.bytes_for(x + width)
    }

    pub fn region(&self) -> Region {
        self.region
    }

    /// Camera pixels summed into one pixel of the array.
    pub fn binned(&self) -> usize {
        (self.region.width / self.shape.1) * (self.region.height / self.shape.0)
    }

    /// The array's counts. Sums of counts that are not linearised are exact: at most 2²⁴ pixels of 16 bits fit f64's 53.
    ///
    /// # Errors
    /// The image is too short, or no JPEG image of the granted size.
    pub fn decode(&self, image: &[u8]) -> Result<Counts, DecodeError> {
        let Granted {
            format, width, height, ..
        } = self.granted;
        if format.is_compressed() {
            let luma = jpeg::luma(image, width, height).map_err(DecodeError::Jpeg)?;
            return Ok(self.bin(format.encoding(), &luma));
        }
        let (found, needed) = (image.len(), self.bytes_needed());
        match found < needed {
            true => Err(DecodeError::Short { found, needed }),
            false => Ok(self.bin(format.encoding(), image)),
        }
    }

    fn bin(&self, encoding: Encoding, image: &[u8]) -> Counts {
        let (ny, nx) = self.shape;
        let Region { x, y, width, height } = self.region;
        let (bin_x, bin_y) = (width / nx, height / ny);
        let mut counts = Array2::zeros(self.shape);
        let mut saturated: Option<Array2<bool>> = None;
        let mut brightest = 0;
        let mut samples = Vec::with_capacity(width + 4);
        for row in 0..height {
            let line = &image[(y + row) * self.granted.stride..];
            unpack::unpack(encoding, line, x, width, &mut samples);
            let to_y = match self.flip[1] {
                false => row / bin_y,
                true => ny - 1 - row / bin_y,
            };
            for (bin, block) in samples.chunks_exact(bin_x).enumerate() {
                let to_x = if self.flip[0] { nx - 1 - bin } else { bin };
                counts[[to_y, to_x]] += match &self.linear {
                    None => block.iter().map(|s| u64::from(*s)).sum::<u64>() as f64,
                    Some(table) => block.iter().map(|s| table[usize::from(*s)]).sum::<f64>(),
                };
                let most = block.iter().copied().max().unwrap_or_default();
                brightest = brightest.max(most);
                if most >= self.saturation {
                    saturated.get_or_insert_with(|| Array2::from_elem(self.shape, false))[[to_y, to_x]] = true;
                }
            }
        }
        if self.black != 0.0 {
            counts -= self.black;
        }
        let brightest = f64::from(brightest) / f64::from(self.saturation);
        Counts {
            counts,
            saturated,
            brightest,
        }
    }
}

/// Converts counts to joules in place. A pixel with a saturated camera pixel in it is raised to `saturation_j`, the level that marks
/// saturation for the estimator, or masked where the config names none.
pub fn to_joules(
    counts: &mut Array2<f64>,
    saturated: Option<Array2<bool>>,
    joules_per_count: f64,
    saturation_j: Option<f64>,
) -> Option<Array2<bool>> {
    *counts *= joules_per_count;
    let saturated = saturated?;
    let Some(ceiling) = saturation_j else {
        return Some(saturated);
    };
    for (value, _) in counts.iter_mut().zip(&saturated).filter(|(_, s)| **s) {
        *value = value.max(ceiling);
    }
    None
}

#[cfg(test)]
#[path = "image_test.rs"]
mod tests;
