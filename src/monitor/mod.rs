//! Floor 3: `step(frame, claims) → report`, synchronous and deterministic. Time is an argument; there is
//! no clock in here, so a replay gives the same alerts every time.

mod alert;
mod bends;
mod blend;
mod book;
mod clock;
mod config;
mod detection;
mod motion;
mod pose;
mod report;
mod residuals;
mod sight;
mod source;
mod steps;
mod thresholds;
mod tracks;
mod users;
mod watch;

pub use alert::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity, Withdrawal,
};
pub use config::{Config, ConfigError};
pub use report::{Observation, PositionStatus, Report, TrackedPosition, UserPosition};
pub use sight::BLINDING_SHARE;
pub use source::Source;
pub use watch::Monitor;
