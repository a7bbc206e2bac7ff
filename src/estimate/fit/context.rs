//! What every fit of one frame shares: the data, what they are predicted with, what may be spent, and scratch memory.

use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::rules::Rules;

/// One frame's problem, its budget, and scratch memory.
pub(crate) struct FitContext<'a, 'b> {
    pub bases: &'a Bases,
    pub compressed: &'a CompressedFrame,
    pub rules: Rules,
    pub budget: &'a mut WorkBudget<'b>,
    pub workspace: &'a mut Workspace,
}

impl<'a> FitContext<'a, '_> {
    /// The problem without a constraint.
    pub fn problem(&self) -> Problem<'a> {
        Problem {
            bases: self.bases,
            compressed: self.compressed,
            constraint: None,
        }
    }
}
