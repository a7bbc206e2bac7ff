//! What a fit is worth: covariance, bound, score test, posterior moments, and positions on the ground.

pub mod confidence;
pub mod covariance;
pub mod cramer_rao;
pub mod ill_determined;
pub mod localise;
pub mod pixel_posterior;
pub mod posterior_mean;
pub mod profile_nonlinearity;
pub mod split_score_test;
