//! The stability study: a catalogue of hard cases, each with what makes it hard, what is promised and what happened.
//!
//! Two promises stand behind every case that shows frames to the estimator: nothing it says is malformed
//! ([`trial::faults`]), and a position that carries no warning is where an emitter is.

mod case;
mod emitters;
mod frames;
mod invariance;
mod ladder;
mod numbers;
mod sensors;
mod table;
pub mod trial;
mod verdicts;

pub(crate) use case::false_alarms_allowed;
pub use case::{Case, Observed, Options, Row, Worst};
pub use table::markdown;

/// Every hard case known.
pub fn catalogue() -> Vec<Case> {
    [
        emitters::cases(),
        frames::cases(),
        sensors::cases(),
        ladder::cases(),
        invariance::cases(),
        numbers::cases(),
        verdicts::cases(),
    ]
    .into_iter()
    .flatten()
    .collect()
}
