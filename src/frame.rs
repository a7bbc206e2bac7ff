//! What the chain begins with: an exposure of the photodetector array.

use jiff::Timestamp;
use ndarray::Array2;

/// One exposure. Shape of `pixels` is (Ny, Nx); row 0 is y_min, column 0 is x_min.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Position in the source's own numbering; gaps are frames that were lost.
    pub index: u64,
    /// Middle of the exposure, UTC.
    pub time: Timestamp,
    /// Collected energy per pixel, J. May hold NaN or ∞ when the source delivered them.
    pub pixels: Array2<f64>,
    /// `true` where the pixel carries no usable value (dead, hot, outside the region of interest).
    /// Saturation is not marked here: it follows from the camera's `saturation_j`.
    pub masked: Option<Array2<bool>>,
    /// How long light was collected, s, where that is known: a camera that moves smears spots by it.
    pub exposure_s: Option<f64>,
    /// What energies are multiplied by to be those of the configured exposure, where a source changes its exposure. `pixels`, as the
    /// noise in them, are of this one.
    pub energy_scale: f64,
}

impl Frame {
    /// A hash of the pixels: frames with noise in them never repeat it, a frozen sensor does.
    pub fn digest(&self) -> u64 {
        // FNV-1a over whole pixels (Fowler, Noll and Vo), with a rotation so that high bits reach low ones.
        self.pixels.iter().fold(0xcbf2_9ce4_8422_2325, |hash: u64, pixel| {
            (hash ^ pixel.to_bits())
                .wrapping_mul(0x0000_0100_0000_01b3)
                .rotate_left(29)
        })
    }
}

#[cfg(test)]
pub mod fixture {
    use super::*;

    /// A dark frame of one pixel.
    pub fn frame(index: u64) -> Frame {
        Frame {
            index,
            time: Timestamp::UNIX_EPOCH,
            pixels: Array2::zeros((1, 1)),
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        }
    }
}
