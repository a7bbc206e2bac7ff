//! What a frame may cost: multiplications, which are the same for every run, and time where a budget is set.

use std::time::Instant;

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;

/// Multiplications that a frame of a few emitters may cost: the same for every run, unlike a clock.
const MOST_WORK: f64 = 1e8;
/// Emitters from which on a frame may cost more, with the square of their number, and up to how many times as many.
const MANY: f64 = 8.0;
const MOST_TIMES: f64 = 5.0;
/// Share that the last fit may take beyond.
pub(crate) const BEYOND: f64 = 1.2;

impl Fitter {
    /// Forgets the work done for the last frame.
    pub fn restart(&mut self, deadline: Option<Instant>) {
        self.work = 0.0;
        self.limit = f64::INFINITY;
        self.most_sources = 0.0;
        self.steps = 0;
        self.deadline = deadline;
    }

    /// Leaves at least this share of a frame's work for what comes.
    pub fn reserve(&mut self, share: f64) {
        self.work = self.work.min((1.0 - share) * self.most_work());
    }

    /// Allows what comes no more than this share of the work on a frame of a few emitters. Returns the limit that stood, for
    /// [`Fitter::lift`].
    pub fn allow(&mut self, share: f64) -> f64 {
        let within = self.limit.min(self.work + share * MOST_WORK);
        std::mem::replace(&mut self.limit, within)
    }

    pub fn lift(&mut self, limit: f64) {
        self.limit = limit;
    }

    pub(crate) fn most_work(&self) -> f64 {
        (MOST_WORK * (self.most_sources / MANY).clamp(1.0, MOST_TIMES).powi(2)).min(self.limit)
    }

    /// Whether the frame has had its share of work, or of time where a budget is set.
    pub fn is_exhausted(&self) -> bool {
        self.work > self.most_work() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Multiplications that one step costs.
    pub(crate) fn step_work(&self, reading: &Reading) -> f64 {
        let sources = self.now.sources() as f64;
        let parameters = 3.0 * sources;
        let bad = &reading.bad;
        let runs = match bad.runs().len() {
            0 => 0.0,
            n => sources * sources * (4 * self.bx.n + 16 * n) as f64,
        };
        let scattered = bad.scattered().len() as f64 * (2.0 * parameters + 0.5 * parameters * parameters);
        let unusable = runs + scattered + 2.0 * bad.work(reading.mx, reading.my);
        let pairs = if reading.weights.is_empty() { 0.0 } else { 3.0 * sources };
        let parts = self.now.parts_a_spot();
        let smears = if parts > 1.0 {
            8.0 * (parts * sources).powi(2) * (reading.mx + reading.my) as f64
        } else {
            0.0
        };
        unusable
            + smears
            + (9.0 + pairs) * self.now.footprint()
            + 40.0 * sources * (reading.mx + reading.my) as f64
            + 9.0 * sources.powi(3)
    }
}
