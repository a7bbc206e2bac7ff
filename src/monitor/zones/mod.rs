//! Zones: places on the ground with rules of their own. An operator draws them in the config, in a GeoJSON file or over the API.

mod check;
mod config;
mod degrees;
mod geojson;
mod index;
mod shape;
mod zone;

pub use check::ZoneError;
pub(in crate::monitor) use check::check_all;
pub use config::{Config, load};
pub use degrees::Coordinates;
pub use geojson::{collection, parse};
pub use index::{Inside, REACH_M, ZoneMap, ignored_share};
pub use shape::{MAX_COORDINATE_M, Shape, ShapeError};
pub use zone::{MAX_ZONES, Zone, ZoneKind};
