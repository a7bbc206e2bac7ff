//! Floor 4: studies: what accuracy costs in time, numerical stability, training data.

pub mod tradeoff;
