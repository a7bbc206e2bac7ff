//! Floor 0: the optics as pure functions. No IO, no clock, no randomness.

pub mod blur;
mod camera;
mod config;
pub mod fading;
pub mod geometry;
pub mod psf;
pub mod radiometry;

pub use camera::{Axis, Camera};
pub use config::{BlurConfig, Config, Error};
