//! Layer 4: studies of accuracy against time and of numerical stability, and training data.

pub mod ablation;
pub mod device;
pub mod formats;
pub mod golden;
pub mod measurements;
pub mod samples;
pub mod stability;
pub mod stories;
pub mod tradeoff;
