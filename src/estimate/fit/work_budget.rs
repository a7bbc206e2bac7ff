//! The computation budget of a frame: multiplications, which are reproducible, and a deadline where one is set.

use std::time::Instant;

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;

/// Multiplications allowed a frame of a few sources: reproducible, unlike a clock.
const MAX_WORK: f64 = 1e8;
/// From this many sources on the allowance grows with the square of their number, up to `MAX_WORK_FACTOR` times as many.
const MANY_SOURCES: f64 = 8.0;
const MAX_WORK_FACTOR: f64 = 5.0;
/// A fit in progress is aborted at this multiple of the allowance.
pub(crate) const OVERRUN: f64 = 1.2;

impl Fitter {
    /// Starts a new frame's budget.
    pub fn reset(&mut self, deadline: Option<Instant>) {
        self.work = 0.0;
        self.work_limit = f64::INFINITY;
        self.max_components = 0.0;
        self.steps = 0;
        self.deadline = deadline;
    }

    /// Leaves at least this share of the allowance for what follows.
    pub fn reserve_work(&mut self, share: f64) {
        self.work = self.work.min((1.0 - share) * self.max_work());
    }

    /// Limits what follows to this share of `MAX_WORK`. Returns the limit before, for [`Fitter::restore_work_limit`].
    pub fn limit_work(&mut self, share: f64) -> f64 {
        let within = self.work_limit.min(self.work + share * MAX_WORK);
        std::mem::replace(&mut self.work_limit, within)
    }

    pub fn restore_work_limit(&mut self, limit: f64) {
        self.work_limit = limit;
    }

    pub(crate) fn max_work(&self) -> f64 {
        (MAX_WORK * (self.max_components / MANY_SOURCES).clamp(1.0, MAX_WORK_FACTOR).powi(2)).min(self.work_limit)
    }

    /// Whether the frame's work is spent, or its deadline has passed.
    pub fn is_exhausted(&self) -> bool {
        self.work > self.max_work() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Multiplications of one step.
    pub(crate) fn step_cost(&self, compressed: &CompressedFrame) -> f64 {
        let components = self.current.components() as f64;
        let parameters = 3.0 * components;
        let masked = &compressed.masked;
        let runs = match masked.runs().len() {
            0 => 0.0,
            n => components * components * (4 * self.bx.n + 16 * n) as f64,
        };
        let scattered = masked.scattered().len() as f64 * (2.0 * parameters + 0.5 * parameters * parameters);
        let unusable = runs + scattered + 2.0 * masked.project_out_cost(compressed.mx, compressed.my);
        let pairs = if compressed.weights.is_empty() {
            0.0
        } else {
            3.0 * components
        };
        let terms = self.current.terms_per_source();
        let smears = if terms > 1.0 {
            8.0 * (terms * components).powi(2) * (compressed.mx + compressed.my) as f64
        } else {
            0.0
        };
        unusable
            + smears
            + (9.0 + pairs) * self.current.footprint()
            + 40.0 * components * (compressed.mx + compressed.my) as f64
            + 9.0 * components.powi(3)
    }
}
