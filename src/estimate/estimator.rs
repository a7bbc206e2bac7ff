//! The interface of an estimator.

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::frame::Frame;

/// Turns a frame into emitters. Holds its scratch memory, so that a frame allocates nothing on the hot path. Deterministic: the
/// same frame gives the same bits.
pub trait Estimator: Send {
    /// The name that `[estimator] name` selects it by.
    fn name(&self) -> &'static str;

    /// Emitters of one frame; a frame that holds nothing gives an empty list.
    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error>;
}
