//! The stability study: a catalogue of hard cases, each with its difficulty, its requirement and its outcome.
//!
//! Every case with frames requires two things of the estimator: its output is well-formed ([`trial::faults`]), and a position
//! without a warning is the position of an emitter.

mod case;
mod emitters;
mod estimators;
mod frames;
mod invariance;
mod numbers;
mod sensors;
mod table;
pub mod trial;
mod verdicts;

pub(crate) use case::false_alarms_allowed;
pub use case::{Case, Observed, Options, Row, Worst};
pub use table::markdown;

/// All hard cases.
pub fn catalogue() -> Vec<Case> {
    [
        emitters::cases(),
        frames::cases(),
        sensors::cases(),
        estimators::cases(),
        invariance::cases(),
        numbers::cases(),
        verdicts::cases(),
    ]
    .into_iter()
    .flatten()
    .collect()
}
