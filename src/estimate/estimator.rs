//! The interface of an estimator.

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::frame::Frame;
use crate::geo::Sight;
use crate::optics::Smear;

/// Turns a frame into emitters. Holds its scratch memory, so that a frame allocates nothing on the hot path. Deterministic: the
/// same frames in the same order give the same bits.
pub trait Estimator: Send {
    /// The name that `[estimator] name` selects it by.
    fn name(&self) -> &'static str;

    /// Emitters of one frame; a frame that holds nothing gives an empty list. Once `is_over` says that the frame's time is up, the best
    /// hypothesis so far is returned: it is asked between fits, and no clock is read here.
    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error>;

    /// How spots move during the exposures of the frames from now on; `None`: as good as not at all.
    fn set_smear(&mut self, smear: Option<&Smear>);

    /// Where the camera of a moving platform is and looks in the next frame; `None`: it stands still. For estimators that remember frames.
    fn set_sight(&mut self, _sight: Option<&Sight>) {}

    /// [`Estimator::estimate_until`] without a limit of time.
    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        self.estimate_until(frame, &|| false)
    }
}
