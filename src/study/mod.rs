//! Layer 4: studies of accuracy against time and of numerical stability, and training data.

pub mod ablation;
pub mod golden;
pub mod samples;
pub mod stability;
pub mod tradeoff;
