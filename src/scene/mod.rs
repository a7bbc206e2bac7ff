//! Floor 1: scene file → plan (only the effects it calls for) → frames with truth. Never uses `estimate`: the simulator
//! must stay an independent judge of the estimator.

mod config;
mod effects;
mod error;
mod motion;
mod network;
mod plan;
mod population;
mod process;
mod recording;
mod render;
mod stream;
mod truth;

pub use config::{ClaimsConfig, IntruderConfig, LinkConfig, RandomEmittersConfig, Scene, UserConfig};
pub use effects::Effects;
pub use error::Error;
pub use motion::{Motion, Schedule};
pub use plan::Plan;
pub use recording::{Element, Recording, WriteError};
pub use stream::{Effect, Ledger};
pub use truth::{EmitterTruth, Role, SimulatedFrame, Truth};
