//! A hard case, its check and its outcome.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use crate::estimate;
use crate::hash::fnv1a;

/// Options of a run.
#[derive(Clone, Debug)]
pub struct Options {
    /// Frames of each kind.
    pub frames: usize,
    pub seed: u64,
    pub estimator: estimate::Config,
}

/// A hard case with its check.
pub struct Case {
    pub group: &'static str,
    pub name: String,
    /// The difficulty.
    pub hard: &'static str,
    /// The requirement.
    pub expected: &'static str,
    check: Box<dyn Fn(&Options) -> Observed>,
}

/// The outcome of a case.
#[derive(Clone, Debug)]
pub struct Observed {
    pub happened: String,
    pub holds: bool,
    /// Worst of all frames, where the case has frames.
    pub fit: Option<Worst>,
}

/// Effort of the estimator, the worst over all frames of a case.
#[derive(Clone, Copy, Debug, Default)]
pub struct Worst {
    /// Largest condition number of an information matrix.
    pub condition: f64,
    /// Most steps of the fit that a frame took.
    pub steps: u64,
    pub time: Duration,
}

/// A case with its outcome.
#[derive(Clone, Debug)]
pub struct Row {
    pub group: &'static str,
    pub name: String,
    pub hard: &'static str,
    pub expected: &'static str,
    pub seen: Observed,
    pub took: Duration,
}

impl Case {
    pub(super) fn new(
        group: &'static str,
        name: impl Into<String>,
        hard: &'static str,
        expected: &'static str,
        check: impl Fn(&Options) -> Observed + 'static,
    ) -> Self {
        Self {
            group,
            name: name.into(),
            hard,
            expected,
            check: Box::new(check),
        }
    }

    /// Runs the case with random frames of its own, so that cases do not share their noise. A panic is an outcome that violates the
    /// requirement.
    pub fn run(&self, options: &Options) -> Row {
        let start = Instant::now();
        let own = fnv1a(self.name.bytes());
        let options = &Options {
            seed: options.seed.wrapping_add(own),
            ..options.clone()
        };
        let observed = catch_unwind(AssertUnwindSafe(|| (self.check)(options))).unwrap_or_else(|_| Observed {
            happened: "panicked".to_owned(),
            holds: false,
            fit: None,
        });
        Row {
            group: self.group,
            name: self.name.clone(),
            hard: self.hard,
            expected: self.expected,
            seen: observed,
            took: start.elapsed(),
        }
    }
}

/// Most false emitters that the estimator's penalty allows in so many frames: one in a thousand frames on average, and more than
/// this number in one of ten thousand studies.
pub(crate) fn false_alarms_allowed(frames: usize) -> usize {
    const RATE: f64 = 1e-3;
    const CHANCE: f64 = 1e-4;
    let mean = RATE * frames as f64;
    let mut term = (-mean).exp();
    let mut beyond = 1.0 - term;
    let mut most = 0;
    while beyond > CHANCE {
        most += 1;
        term *= mean / most as f64;
        beyond -= term;
    }
    most
}
