//! Floor 3: `step(frame, claims) → report`, synchronous and deterministic. Time is an argument; there is
//! no clock in here, so a replay gives the same alerts every time.

mod alert;
mod alert_ids;
mod alert_lifecycle;
mod ambiguity;
mod by_user;
mod cleared_causes;
mod config;
mod evidence;
mod finding;
#[cfg(test)]
mod fixture;
mod frame_context;
mod input;
#[expect(clippy::module_inception, reason = "the list of files names the stages")]
mod monitor;
mod pose;
mod report;
mod rules;
mod stats;
mod summary;
mod track;

pub use alert::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity, Withdrawal,
};
pub use config::{Config, ConfigError, Source};
pub use input::sensor_health::BLINDING_SHARE;
pub use monitor::Monitor;
pub use report::{Observation, PositionStatus, Report, TrackedPosition, UserPosition};
