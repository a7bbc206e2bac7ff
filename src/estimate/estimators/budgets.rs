//! The work of a frame's searches.

use crate::estimate::fit::work_budget::WorkBudget;

/// What each of a frame's searches may spend.
pub(crate) struct Budgets<'a> {
    pub search: WorkBudget<'a>,
    pub pencil: WorkBudget<'a>,
    pub reweighting: WorkBudget<'a>,
}

impl<'a> Budgets<'a> {
    pub fn new(is_over: &'a dyn Fn() -> bool) -> Self {
        let budget = || WorkBudget::new(is_over);
        Self {
            search: budget(),
            pencil: budget(),
            reweighting: budget(),
        }
    }

    pub fn steps(&self) -> u64 {
        self.search.steps + self.pencil.steps + self.reweighting.steps
    }

    pub fn is_limited(&self) -> bool {
        self.search.is_limited || self.pencil.is_limited || self.reweighting.is_limited
    }
}
