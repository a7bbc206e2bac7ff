//! Floor 3: `step(frame, claims) → report`, synchronous and deterministic. Time is an argument; there is
//! no clock in here, so a replay gives the same alerts every time.

mod alert;
mod alert_ids;
mod alert_lifecycle;
mod ambiguity;
mod beyond_view;
mod by_user;
mod cleared_causes;
mod config;
mod evidence;
mod finding;
#[cfg(test)]
mod fixture;
mod frame_context;
mod input;
mod known_lights;
mod light_history;
mod maintenance;
#[expect(clippy::module_inception, reason = "the list of files names the stages")]
mod monitor;
mod operator;
mod places;
mod pose;
mod report;
mod rules;
mod stats;
mod summary;
mod track;
pub mod zones;

pub use alert::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, GeodeticFields, Severity,
    StationName, Withdrawal,
};
pub use config::{Config, ConfigError, Source};
pub use input::sensor_health::BLINDING_SHARE;
pub use known_lights::{
    Config as KnownLightConfig, KnownLight, KnownLightStatus, Learned, LightError, LightRecord, LightSource,
    MAX_LIGHTS, Request as LightRequest, from_config as known_lights_of,
};
pub use maintenance::{Config as MaintenanceConfig, MaintenanceError, Window, windows_of};
pub use monitor::Monitor;
pub use report::{Look, Observation, PositionStatus, Report, TrackedPosition, UserPosition};
