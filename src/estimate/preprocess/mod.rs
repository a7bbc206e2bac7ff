//! From pixels to numbers in units of the noise: which pixels may be used, and how noisy they are.

pub mod masked_pixels;
pub mod noise_variance;
pub mod outliers;
pub mod screening;
