//! The scratch memory of fits.

use crate::estimate::fit::damped_step::Step;
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::fit::scratch::Scratch;

/// Buffers that grow to the largest problem seen and then allocate nothing. They hold no state between fits.
#[derive(Default)]
pub(crate) struct Workspace {
    /// The hypothesis that a fit stands at, and the one that it tries.
    pub current: Evaluation,
    pub trial: Evaluation,
    /// Of `current`.
    pub equations: NormalEquations,
    pub step: Step,
    pub scratch: Scratch,
}
