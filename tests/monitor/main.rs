//! The monitor run on stories: what it must raise, when, and that it raises nothing else. The files are those of `src/monitor`; what
//! needs no story is tested there.

mod alert_lifecycle;
mod hostile;
mod input;
mod monitor;
mod rules;
#[path = "../stories/mod.rs"]
mod stories;
mod track;

const SEEDS: std::ops::Range<u64> = 0..5;
