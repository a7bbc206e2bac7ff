//! What lies below the page's map where it is configured: a picture with its corners, or tiles for maps without the internet.

mod config;
mod raster;
pub mod routes;
mod source;
mod tiles;

pub use config::{Config, Error};
pub use source::Background;
