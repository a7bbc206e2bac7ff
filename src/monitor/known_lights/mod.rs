//! Known lights: emitters that nobody claims and that an operator has approved. They are tracked like users, and tested for change.

mod light;
mod range;
mod registry;
mod state;

pub use light::{Config, KnownLight, LightError, LightSource, MAX_LIGHTS, Request, from_config};
pub use range::Learned;
pub use registry::LightRecord;
pub use state::KnownLightStatus;

pub(super) use range::Change;
pub(super) use registry::KnownLights;
pub(super) use state::LightState;
