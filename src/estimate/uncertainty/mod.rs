//! What a fit is worth: covariances, bounds, tests of the model, positions on the ground.

pub mod covariance;
pub mod cramer_rao;
pub mod localise;
pub mod pixel_posterior;
pub mod posterior_mean;
pub mod profile_nonlinearity;
pub mod split_score_test;
