//! Floor 3: `step(frame, claims) → report`, synchronous and deterministic. Time is an argument; there is
//! no clock in here, so a replay gives the same alerts every time.

mod alert;
mod config;
mod report;

pub use alert::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};
pub use config::Config;
pub use report::{Observation, PositionStatus, Report, TrackedPosition, UserPosition};
