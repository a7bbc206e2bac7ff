//! Floor 0: the optics as pure functions. No IO, no clock, no randomness.

pub mod blur;
mod calibration;
mod camera;
mod config;
mod distortion;
pub mod fading;
pub mod geometry;
pub mod psf;
pub mod radiometry;

pub use calibration::{Calibration, CalibrationError, PixelMaps};
pub use camera::{Axis, Camera};
pub use config::{BlurConfig, Config, Error};
pub use distortion::Distortion;
