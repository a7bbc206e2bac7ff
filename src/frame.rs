//! The one thing every floor hands on: an exposure of the photodetector array.

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
}
