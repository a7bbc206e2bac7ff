//! One frame → emitters on the sensor and on the ground, with covariance. Uses `optics`, never `scene` (the simulator stays an
//! independent judge) and never claims (an attacker writes those).
//!
//! The folders are the steps of a frame's way: `preprocess` masks pixels and measures the noise, `model` predicts a frame from a
//! hypothesis, `detect` finds starting points, `fit` is Levenberg–Marquardt, `model_order` chooses the number of emitters,
//! `uncertainty` is what a fit is worth, `estimators` composes them, and `sequence` remembers the frames before.

mod config;
mod dense_linalg;
mod detect;
mod emitter;
mod error;
mod estimator;
mod estimators;
mod fit;
mod model;
mod model_order;
mod preprocess;
mod rules;
mod sequence;
#[doc(hidden)]
pub mod stages;
#[cfg(test)]
mod test_frame;
mod uncertainty;

pub use config::{Config, ConfigError, KnownPower};
pub use detect::heatmap_network::NetworkError;
pub use emitter::{Emitter, Estimate, Flags, SecondMomentScore, Velocity};
pub use error::Error;
pub use estimator::Estimator;
pub use estimators::build::build;
pub use estimators::list::{DEFAULT, ESTIMATORS, EstimatorSpec, Learned, find};
pub(crate) use preprocess::screening::is_usable;
pub use rules::Rules;
pub use uncertainty::cramer_rao::{BoundAssumptions, PsfShape, position_bound, position_bound_with};
