//! Why a frame cannot be estimated at all.

use crate::estimate::detect::heatmap_network::NetworkError;

/// Why a frame cannot be used at all. Anything milder is a flag on the emitter.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    #[error("frame is {found_x} × {found_y} pixels, the config says {expected_x} × {expected_y}")]
    WrongShape {
        expected_x: usize,
        expected_y: usize,
        found_x: usize,
        found_y: usize,
    },
    #[error("no usable pixel: {nan} of {total} are NaN or infinite, {saturated} saturated, {masked} masked")]
    NoUsablePixel {
        total: usize,
        nan: usize,
        saturated: usize,
        masked: usize,
    },
    #[error(transparent)]
    Network(#[from] NetworkError),
}
