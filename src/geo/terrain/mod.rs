//! The ground as heights of a digital elevation model: where rays meet it, and its files.

mod crossing;
mod error;
mod geotiff;
mod hgt;
mod load;
mod raster;
mod surface;
mod utm;

pub use error::{Error, Fault};
pub use surface::{Ground, Terrain};
