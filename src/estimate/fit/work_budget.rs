//! The computation budget of a frame: multiplications, which are reproducible, and the caller's test of whether time is up.

use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::separable_model::SeparableModel;

/// Multiplications allowed a frame of a few sources: reproducible, unlike a clock. More would be spent on frames that no hypothesis
/// explains, less ends searches in crowded ones; `[estimator] budget_ms` bounds the time as well.
const MAX_WORK: f64 = 1e8;
/// From this many sources on the allowance grows with the square of their number (a step costs that much), up to `MAX_WORK_FACTOR` times as
/// many, which bounds the time that an attacker's crowd can take.
const MANY_SOURCES: f64 = 8.0;
const MAX_WORK_FACTOR: f64 = 5.0;
/// A fit in progress is aborted at this multiple of the allowance; below it the fit ends and its result counts.
const OVERRUN: f64 = 1.2;

/// What a frame has cost and what it may cost.
pub(crate) struct WorkBudget<'a> {
    /// Multiplications spent.
    spent: f64,
    /// Factor on the allowance.
    frames: f64,
    /// Limit of the work, whatever the hypotheses.
    limit: f64,
    /// Components of the largest hypothesis.
    max_components: f64,
    /// Steps of fits taken.
    pub steps: u64,
    /// Whether a reserve has forgiven work.
    is_forgiven: bool,
    /// Whether a search left light because it had as many sources as it may.
    pub is_limited: bool,
    is_over: &'a dyn Fn() -> bool,
}

impl<'a> WorkBudget<'a> {
    /// A new frame's budget; `is_over` says whether its time is up.
    pub fn new(is_over: &'a dyn Fn() -> bool) -> Self {
        Self {
            spent: 0.0,
            frames: 1.0,
            limit: f64::INFINITY,
            max_components: 0.0,
            steps: 0,
            is_forgiven: false,
            is_limited: false,
            is_over,
        }
    }

    /// The budget of as many frames together.
    pub fn of_frames(frames: f64, is_over: &'a dyn Fn() -> bool) -> Self {
        Self {
            frames,
            ..Self::new(is_over)
        }
    }

    pub fn charge(&mut self, multiplications: f64) {
        self.spent += multiplications;
    }

    /// Charges one step of a fit of `components` components.
    pub fn charge_step(&mut self, components: usize, multiplications: f64) {
        self.max_components = self.max_components.max(components as f64);
        self.spent += multiplications;
        self.steps += 1;
    }

    /// Leaves at least this share of the allowance for what follows.
    pub fn reserve(&mut self, share: f64) {
        let most = (1.0 - share) * self.allowance();
        self.is_forgiven |= self.spent > most;
        self.spent = self.spent.min(most);
    }

    /// Limits what follows to this share of `MAX_WORK`. Returns the limit before, for [`WorkBudget::restore_limit`].
    pub fn limit(&mut self, share: f64) -> f64 {
        let within = self.limit.min(self.spent + share * MAX_WORK);
        std::mem::replace(&mut self.limit, within)
    }

    pub fn restore_limit(&mut self, limit: f64) {
        self.limit = limit;
    }

    /// Grants the whole allowance again, as for a new frame.
    pub fn restart(&mut self) {
        self.spent = 0.0;
        self.max_components = 0.0;
        self.is_forgiven = false;
    }

    /// Whether the allowance has never ended anything, so that more would have changed nothing.
    pub fn was_ample(&self) -> bool {
        !self.is_forgiven && !self.is_exhausted()
    }

    fn allowance(&self) -> f64 {
        (self.frames * MAX_WORK * (self.max_components / MANY_SOURCES).clamp(1.0, MAX_WORK_FACTOR).powi(2))
            .min(self.limit)
    }

    /// Whether the frame's work is spent, or its time is up.
    pub fn is_exhausted(&self) -> bool {
        self.spent > self.allowance() || (self.is_over)()
    }

    /// Whether even a fit in progress has to end.
    pub fn is_overrun(&self) -> bool {
        self.spent > OVERRUN * self.allowance()
    }
}

/// Multiplications of one step of a fit.
pub(crate) fn step_cost(bases: &Bases, compressed: &CompressedFrame, model: &SeparableModel) -> f64 {
    let components = model.components() as f64;
    let parameters = 3.0 * components;
    let masked = &compressed.masked;
    let runs = match masked.runs().len() {
        0 => 0.0,
        n => components * components * (4 * bases.x.n + 16 * n) as f64,
    };
    let scattered = masked.scattered().len() as f64 * (2.0 * parameters + 0.5 * parameters * parameters);
    let unusable = runs + scattered + 2.0 * masked.project_out_cost(compressed.mx, compressed.my);
    let terms = model.terms_per_source();
    let smears = if terms > 1.0 {
        8.0 * (terms * components).powi(2) * (compressed.mx + compressed.my) as f64
    } else {
        0.0
    };
    unusable
        + smears
        + model.pass_cost(!compressed.weights.is_empty())
        + 40.0 * components * (compressed.mx + compressed.my) as f64
        + 9.0 * components.powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_ends_a_frame_and_a_limit_ends_a_part_of_it() {
        let mut budget = WorkBudget::new(&|| false);
        budget.charge(0.5 * MAX_WORK);
        assert!(!budget.is_exhausted());
        let before = budget.limit(0.1);
        budget.charge(0.11 * MAX_WORK);
        assert!(budget.is_exhausted() && !budget.is_overrun(), "a tenth is spent");
        budget.restore_limit(before);
        assert!(!budget.is_exhausted());
        budget.charge(0.5 * MAX_WORK);
        assert!(budget.is_exhausted());
        budget.charge_step(16, 0.0);
        assert!(!budget.is_exhausted(), "twice the sources may cost four times as much");
        budget.charge(4.0 * MAX_WORK);
        assert!(budget.is_overrun());
        budget.reserve(0.25);
        assert!(!budget.is_exhausted(), "a quarter is left");
    }

    #[test]
    fn time_ends_a_frame_whatever_it_has_cost() {
        let calls = std::cell::Cell::new(0);
        let is_over = || {
            calls.set(calls.get() + 1);
            calls.get() > 2
        };
        let budget = WorkBudget::new(&is_over);
        assert!(!budget.is_exhausted() && !budget.is_exhausted() && budget.is_exhausted());
    }
}
