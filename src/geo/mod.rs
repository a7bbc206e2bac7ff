//! Places on the earth and on the ground: WGS-84 and local axes, and the camera's rays to the ground (a plane, or terrain) with their
//! Jacobians.

mod config;
mod geoid;
mod pose_error;
mod sight;
mod smear;
mod terrain;
mod view;
mod wgs84;

pub use config::{Config, ConfigError, Datum, Origin};
pub use geoid::undulation_m;
pub use pose_error::PoseError;
pub use sight::{GroundPoint, Sight};
pub use terrain::{Error as TerrainError, Fault as TerrainFault, Ground, Terrain};
pub use view::{Placed, View};
pub use wgs84::{Geodetic, LocalAxes};
