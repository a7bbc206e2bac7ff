//! Decodes a camera image into the photodetector array: pure functions.

use ndarray::Array2;
use serde::{Deserialize, Serialize};

/// Grey formats of one value a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PixelFormat {
    GREY,
    Y10,
    Y12,
    Y16,
    #[serde(rename = "Y16_BE")]
    Y16Be,
}

impl PixelFormat {
    /// Deepest first: the order of preference when none is configured.
    pub const ALL: [Self; 5] = [Self::Y16, Self::Y16Be, Self::Y12, Self::Y10, Self::GREY];

    /// The kernel's code. Big-endian formats carry bit 31.
    pub fn fourcc(self) -> u32 {
        let code = |name: [u8; 4]| u32::from_le_bytes(name);
        match self {
            Self::GREY => code(*b"GREY"),
            Self::Y10 => code(*b"Y10 "),
            Self::Y12 => code(*b"Y12 "),
            Self::Y16 => code(*b"Y16 "),
            Self::Y16Be => code(*b"Y16 ") | 1 << 31,
        }
    }

    pub fn from_fourcc(fourcc: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.fourcc() == fourcc)
    }

    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::GREY => 1,
            Self::Y10 | Self::Y12 | Self::Y16 | Self::Y16Be => 2,
        }
    }

    /// The largest count a pixel can hold.
    pub fn full_scale(self) -> u16 {
        match self {
            Self::GREY => 0xff,
            Self::Y10 => 0x3ff,
            Self::Y12 => 0xfff,
            Self::Y16 | Self::Y16Be => 0xffff,
        }
    }
}

/// A four-character code as text.
pub fn fourcc_name(fourcc: u32) -> String {
    let bytes = (fourcc & !(1 << 31)).to_le_bytes();
    let name: String = bytes
        .iter()
        .map(|b| char::from(*b))
        .filter(|c| c.is_ascii_graphic())
        .collect();
    match fourcc >> 31 {
        0 => name,
        _ => name + "_BE",
    }
}

/// Part of a camera image, in camera pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
}

/// How a camera image becomes the array: a region, cut into Ny × Nx equal blocks whose counts are summed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    format: PixelFormat,
    stride: usize,
    region: Region,
    shape: (usize, usize),
    flip: [bool; 2],
    /// A camera pixel at or above this count is saturated.
    saturation: u16,
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
    #[error("the driver reports rows of {stride} bytes for {width} pixels of {bytes} bytes")]
    Stride { stride: usize, width: usize, bytes: usize },
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
    /// `shape` is the array's (Ny, Nx); without a region the whole image is used. `flip` mirrors x and y, for a
    /// camera whose first column or row is not the array's minimum.
    pub fn new(
        granted: Granted,
        region: Option<Region>,
        shape: (usize, usize),
        flip: [bool; 2],
        saturation: Option<u16>,
    ) -> Result<Self, LayoutError> {
        let Granted {
            format,
            width,
            height,
            stride,
        } = granted;
        let row = width * format.bytes_per_pixel();
        let stride = if stride == 0 { row } else { stride };
        if stride < row {
            return Err(LayoutError::Stride {
                stride,
                width,
                bytes: format.bytes_per_pixel(),
            });
        }
        let region = region.unwrap_or(Region {
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
        let (ny, nx) = shape;
        if w == 0 || h == 0 || w % nx != 0 || h % ny != 0 {
            return Err(LayoutError::NotDivisible {
                width: w,
                height: h,
                nx,
                ny,
            });
        }
        Ok(Self {
            format,
            stride,
            region,
            shape,
            flip,
            saturation: saturation.unwrap_or(u16::MAX).min(format.full_scale()),
        })
    }

    /// Bytes that an image must have at least.
    pub fn bytes_needed(&self) -> usize {
        let Region { x, y, width, height } = self.region;
        (y + height - 1) * self.stride + (x + width) * self.format.bytes_per_pixel()
    }

    /// Camera pixels summed into one pixel of the array.
    pub fn binned(&self) -> usize {
        (self.region.width / self.shape.1) * (self.region.height / self.shape.0)
    }

    /// Counts of the array, shape (Ny, Nx), and where at least one of the camera pixels was saturated. `None`
    /// when the image is too short. The sums are exact: at most 2²⁴ pixels of 16 bits fit f64's 53.
    pub fn decode(&self, image: &[u8]) -> Option<(Array2<f64>, Option<Array2<bool>>)> {
        if image.len() < self.bytes_needed() {
            return None;
        }
        match self.format {
            PixelFormat::GREY => Some(self.bin(image, |[b]: [u8; 1]| b.into())),
            PixelFormat::Y10 | PixelFormat::Y12 => {
                // The bits above the format's depth are undefined.
                let mask = self.format.full_scale();
                Some(self.bin(image, |b| u16::from_le_bytes(b) & mask))
            }
            PixelFormat::Y16 => Some(self.bin(image, u16::from_le_bytes)),
            PixelFormat::Y16Be => Some(self.bin(image, u16::from_be_bytes)),
        }
    }

    fn bin<const N: usize>(&self, image: &[u8], count: impl Fn([u8; N]) -> u16) -> (Array2<f64>, Option<Array2<bool>>) {
        let (ny, nx) = self.shape;
        let Region { x, y, width, height } = self.region;
        let (bin_x, bin_y) = (width / nx, height / ny);
        let mut sums = Array2::zeros(self.shape);
        let mut saturated: Option<Array2<bool>> = None;
        for row in 0..height {
            let start = (y + row) * self.stride + x * N;
            let pixels = image[start..start + width * N].as_chunks::<N>().0;
            let to_y = match self.flip[1] {
                false => row / bin_y,
                true => ny - 1 - row / bin_y,
            };
            for (bin, block) in pixels.chunks_exact(bin_x).enumerate() {
                let to_x = if self.flip[0] { nx - 1 - bin } else { bin };
                let mut sum = 0u64;
                for pixel in block {
                    let value = count(*pixel);
                    sum += u64::from(value);
                    if value >= self.saturation {
                        saturated.get_or_insert_with(|| Array2::from_elem(self.shape, false))[[to_y, to_x]] = true;
                    }
                }
                sums[[to_y, to_x]] += sum as f64;
            }
        }
        (sums, saturated)
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
mod tests {
    use ndarray::array;

    use super::*;

    fn granted(format: PixelFormat, width: usize, height: usize, stride: usize) -> Granted {
        Granted {
            format,
            width,
            height,
            stride,
        }
    }

    fn whole(format: PixelFormat, shape: (usize, usize)) -> Layout {
        Layout::new(granted(format, shape.1, shape.0, 0), None, shape, [false; 2], None).unwrap()
    }

    #[test]
    fn every_format_decodes_its_counts() {
        let le = [0x34, 0xf2, 0x01, 0x00];
        let cases = [
            (PixelFormat::GREY, &le[..2], array![[52.0, 242.0]]),
            (PixelFormat::Y10, &le[..], array![[564.0, 1.0]]),
            (PixelFormat::Y12, &le[..], array![[564.0, 1.0]]),
            (PixelFormat::Y16, &le[..], array![[62004.0, 1.0]]),
            (PixelFormat::Y16Be, &le[..], array![[13554.0, 256.0]]),
        ];
        for (format, bytes, expected) in cases {
            let (counts, saturated) = whole(format, (1, 2)).decode(bytes).unwrap();
            assert_eq!(counts, expected, "{format:?}");
            assert!(saturated.is_none());
            assert_eq!(PixelFormat::from_fourcc(format.fourcc()), Some(format));
        }
        assert_eq!(fourcc_name(PixelFormat::Y16Be.fourcc()), "Y16_BE");
        assert_eq!(fourcc_name(PixelFormat::Y10.fourcc()), "Y10");
    }

    #[test]
    fn a_padded_image_s_region_is_binned_exactly() {
        // 5 × 4 pixels, rows of 7 bytes; the padding must never be read as light.
        let mut image = [250u8; 28];
        for y in 0..4 {
            for x in 0..5 {
                image[7 * y + x] = (10 * y + x) as u8;
            }
        }
        let roi = Region {
            x: 1,
            y: 2,
            width: 4,
            height: 2,
        };
        let layout = Layout::new(granted(PixelFormat::GREY, 5, 4, 7), Some(roi), (1, 2), [false; 2], None).unwrap();
        assert_eq!(layout.binned(), 4);
        let (counts, _) = layout.decode(&image).unwrap();
        assert_eq!(counts, array![[21.0 + 22.0 + 31.0 + 32.0, 23.0 + 24.0 + 33.0 + 34.0]]);
        assert_eq!(layout.bytes_needed(), 3 * 7 + 5);
        assert!(layout.decode(&image[..25]).is_none());
        assert!(layout.decode(&image[..26]).is_some());
    }

    #[test]
    fn flips_mirror_the_array() {
        let granted = granted(PixelFormat::GREY, 2, 2, 2);
        let flipped = |flip| {
            Layout::new(granted, None, (2, 2), flip, None)
                .unwrap()
                .decode(&[1, 2, 3, 4])
                .unwrap()
                .0
        };
        assert_eq!(flipped([true, false]), array![[2.0, 1.0], [4.0, 3.0]]);
        assert_eq!(flipped([false, true]), array![[3.0, 4.0], [1.0, 2.0]]);
    }

    #[test]
    fn one_saturated_camera_pixel_saturates_its_array_pixel() {
        let layout = Layout::new(granted(PixelFormat::GREY, 4, 1, 4), None, (1, 2), [false; 2], None).unwrap();
        let (mut counts, saturated) = layout.decode(&[255, 0, 100, 101]).unwrap();
        assert_eq!(saturated, Some(array![[true, false]]));
        let masked = to_joules(&mut counts.clone(), saturated.clone(), 0.5, None);
        assert_eq!(masked, Some(array![[true, false]]));
        assert_eq!(to_joules(&mut counts, saturated, 0.5, Some(1000.0)), None);
        assert_eq!(counts, array![[1000.0, 100.5]]);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let image = granted(PixelFormat::Y16, 640, 480, 1280);
        let region = |x, y, width, height| Some(Region { x, y, width, height });
        let layout = |region, shape| Layout::new(image, region, shape, [false; 2], None);
        assert!(layout(region(96, 16, 448, 448), (64, 64)).is_ok());
        assert!(matches!(
            layout(None, (64, 64)),
            Err(LayoutError::NotDivisible { height: 480, .. })
        ));
        assert!(matches!(
            layout(region(0, 0, 0, 0), (64, 64)),
            Err(LayoutError::NotDivisible { .. })
        ));
        for outside in [region(200, 0, 448, 448), region(usize::MAX, 0, 64, 64)] {
            assert!(matches!(
                layout(outside, (64, 64)),
                Err(LayoutError::OutsideImage { .. })
            ));
        }
        let short_rows = granted(PixelFormat::Y16, 640, 480, 640);
        assert!(matches!(
            Layout::new(short_rows, None, (60, 64), [false; 2], None),
            Err(LayoutError::Stride { .. })
        ));
    }
}
