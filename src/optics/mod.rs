//! Layer 0: the optics as pure functions, without IO, clock or randomness.

pub mod blur;
mod calibration;
mod camera;
mod config;
mod distortion;
mod error;
pub mod fading;
pub mod geometry;
mod pixel_maps;
pub mod psf;
pub mod radiometry;
mod smear;
pub mod spot;
mod spot_pixels;

pub use calibration::Calibration;
pub use camera::{Axis, Camera, SpotError};
pub use config::{BlurConfig, Config};
pub use distortion::Distortion;
pub use error::{CalibrationError, Error};
pub use pixel_maps::PixelMaps;
pub use smear::{COHERENCE_S, DisplacedSpots, Smear, light_std};
pub use spot::SpotShape;
pub use spot_pixels::add_spot;
