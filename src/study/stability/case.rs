//! A hard case, how it is tried, and what was seen.

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
    /// The worst of all frames, where frames were shown to the estimator.
    pub fit: Option<Worst>,
}

/// How hard the estimator found it, over all frames of a case.
#[derive(Clone, Copy, Debug, Default)]
pub struct Worst {
    /// Largest condition number of an information matrix.
    pub condition: f64,
    /// Most steps of the fit that a frame took.
    pub steps: u64,
    pub time: Duration,
}

/// A case after it was tried.
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

    /// Tries the case, with frames of its own: cases that share their noise would share its accidents. A panic is an observation like any other: the promise is broken.
    pub fn run(&self, options: &Options) -> Row {
        let start = Instant::now();
        // FNV-1a: the same everywhere and for ever, unlike the standard library's hashes.
        let own = self.name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash: u64, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
        });
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

/// Emitters invented where none is that the estimator's price of an emitter allows in so many frames: one in a thousand frames
/// on average, and more than this number in one of ten thousand studies.
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
