//! Floor 1: one frame → emitters with covariance. Uses `optics`, never `scene` (the simulator stays an
//! independent judge) and never claims (an attacker writes those).

mod amplitudes;
mod analytic;
mod atoms;
mod basis;
mod bend;
mod bound;
mod config;
mod corrected;
mod covariance;
#[cfg(test)]
mod descent;
mod effort;
mod emitter;
mod fit;
mod ground;
mod heatmap;
mod ladder;
mod learned;
mod linear;
mod linearise;
mod model;
mod moves;
mod network;
mod noise;
mod otherwise;
mod part;
mod parts;
mod pencil;
mod posterior;
mod power;
mod reading;
mod screen;
mod search;
mod spot;
mod spread;
#[doc(hidden)]
pub mod stages;
mod step;
mod straight;
mod unusable;
mod valley;
mod weigh;

pub use bound::{Beside, Shape, position_bound, position_bound_beside};
pub use config::Config;
pub use emitter::{Bend, Emitter, Estimate, Flags};
pub use ladder::{ConfigError, DEFAULT, LADDER, Rung, build, rung};
pub use learned::Learned;
pub use network::NetworkError;
pub use power::KnownPower;

use crate::frame::Frame;

/// A rung of the ladder: turns a frame into emitters. Holds its scratch memory, so that a frame allocates
/// nothing on the hot path. Deterministic: the same frame gives the same bits.
pub trait Estimator: Send {
    /// The name that `[estimator] name` selects it by.
    fn name(&self) -> &'static str;

    /// Emitters of one frame; a frame that holds nothing gives an empty list.
    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error>;
}

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
