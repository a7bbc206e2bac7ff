//! The estimators that `[estimator] name` selects from.

pub mod analytic;
pub mod budgets;
pub mod build;
pub mod frame_search;
pub mod lens_shape;
pub mod list;
pub mod network;
pub mod network_start;
pub mod pixel_correction;
pub mod search_bases;
pub mod spot_learner;
pub mod width_learner;
pub mod windowed;
