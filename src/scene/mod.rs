//! Layer 1: scene file → plan (only the effects it calls for) → frames with truth. Never uses `estimate`: the simulator must stay
//! an independent reference for the estimator.

mod average;
mod config;
mod detector;
mod effect;
mod effects;
mod error;
mod exposure;
mod light;
mod moment;
mod motion;
mod network;
mod plan;
mod platform;
mod population;
mod process;
mod render;
mod report;
mod stream;
mod truth;

pub use config::{ClaimsConfig, IntruderConfig, LinkConfig, RandomEmittersConfig, Scene, UserConfig};
pub use effect::Effect;
pub use effects::*;
pub use error::Error;
pub use motion::{Beside, Drift, Motion, Roam, Schedule, Walk};
pub use plan::{Maker, Plan};
pub use platform::{Drag, FlightLog, Orbit, PlatformConfig, Sway, TelemetryConfig};
pub use report::{Decision, Status};
pub use stream::Ledger;
pub use truth::{EmitterTruth, Role, SimulatedFrame, Truth};
