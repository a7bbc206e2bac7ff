//! The stability study: a catalogue of hard cases, each with what makes it hard, what is promised and what happened.
//!
//! Two promises stand behind every case that shows frames to the estimator: nothing it says is malformed
//! ([`trial::faults`]), and a position that carries no warning is where an emitter is.

mod emitters;
mod frames;
mod invariance;
mod numbers;
mod sensors;
mod table;
pub mod trial;

pub use table::markdown;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use crate::estimate;

/// How thoroughly to look.
#[derive(Clone, Debug)]
pub struct Options {
    /// Frames of each kind.
    pub frames: usize,
    pub seed: u64,
    pub estimator: estimate::Config,
}

/// Something hard, and how to see whether the program bears it.
pub struct Case {
    pub group: &'static str,
    pub name: String,
    /// What makes it hard.
    pub hard: &'static str,
    /// What is promised.
    pub expected: &'static str,
    check: Box<dyn Fn(&Options) -> Observed>,
}

/// What was seen.
#[derive(Clone, Debug)]
pub struct Observed {
    pub happened: String,
    pub holds: bool,
}

/// A case after it was tried.
#[derive(Clone, Debug)]
pub struct Row {
    pub group: &'static str,
    pub name: String,
    pub hard: &'static str,
    pub expected: &'static str,
    pub happened: String,
    pub holds: bool,
    pub took: Duration,
}

impl Case {
    fn new(
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

    /// Tries the case. A panic is an observation like any other: the promise is broken.
    pub fn run(&self, options: &Options) -> Row {
        let start = Instant::now();
        let observed = catch_unwind(AssertUnwindSafe(|| (self.check)(options))).unwrap_or_else(|_| Observed {
            happened: "panicked".to_owned(),
            holds: false,
        });
        Row {
            group: self.group,
            name: self.name.clone(),
            hard: self.hard,
            expected: self.expected,
            happened: observed.happened,
            holds: observed.holds,
            took: start.elapsed(),
        }
    }
}

/// Every hard case known.
pub fn catalogue() -> Vec<Case> {
    [
        emitters::cases(),
        frames::cases(),
        sensors::cases(),
        invariance::cases(),
        numbers::cases(),
    ]
    .into_iter()
    .flatten()
    .collect()
}
