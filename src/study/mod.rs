//! Floor 4: studies: what accuracy costs in time, numerical stability, training data.

pub mod golden;
pub mod samples;
pub mod stability;
pub mod tradeoff;
