//! The estimators that `[estimator] name` selects from.

pub mod analytic;
pub mod build;
pub mod list;
pub mod network;
pub mod pixel_correction;
pub mod windowed;
