//! `[platform]` of a scene: how the platform moves, and what its autopilot says of that.

mod flight;
mod telemetry;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::pose::Mount;
use crate::toml_file::{Key, OutOfRange};

pub(super) use flight::{Flight, Sight};
pub(super) use telemetry::Telemetry;
pub use telemetry::{Drag, TelemetryConfig};

/// A platform that moves: it starts over (0, 0) at `[optics] altitude_m`, and its laws of motion add up.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlatformConfig {
    /// The camera's attitude in the body.
    pub mount: Mount,
    /// At the start, clockwise from north.
    pub heading_deg: f64,
    pub yaw_rate_deg_s: f64,
    pub sway: Option<Sway>,
    /// East, north, up.
    pub velocity_m_s: [f64; 3],
    pub orbit: Option<Orbit>,
    /// A flight log of PX4 in place of these laws.
    pub log: Option<FlightLog>,
    pub telemetry: TelemetryConfig,
}

/// Roll and pitch as sines of time, their phases drawn once.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sway {
    pub amplitude_deg: [f64; 2],
    pub period_s: [f64; 2],
}

/// A circle about the place that the platform would otherwise have, begun in the east.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Orbit {
    pub radius_m: f64,
    pub period_s: f64,
}

/// A recorded flight: its attitudes and, where the log holds them, its movements from where it was at `start_s`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightLog {
    pub file: PathBuf,
    /// The time of frame 0 since the log's first attitude.
    #[serde(default)]
    pub start_s: f64,
}

impl PlatformConfig {
    pub(super) fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        let mount = field.at("mount");
        for (name, angle) in [
            ("roll_deg", self.mount.roll_deg),
            ("pitch_deg", self.mount.pitch_deg),
            ("yaw_deg", self.mount.yaw_deg),
        ] {
            mount.at(name).within(angle, -360.0..=360.0, "degrees")?;
        }
        field.at("heading_deg").finite(self.heading_deg)?;
        field.at("yaw_rate_deg_s").finite(self.yaw_rate_deg_s)?;
        if let Some(sway) = &self.sway {
            let field = field.at("sway");
            for (amplitude, period) in sway.amplitude_deg.into_iter().zip(sway.period_s) {
                field
                    .at("amplitude_deg")
                    .within(amplitude, 0.0..=60.0, "degrees; more would look past the horizon")?;
                field.at("period_s").positive(period)?;
            }
        }
        for speed in self.velocity_m_s {
            field.at("velocity_m_s").finite(speed)?;
        }
        if let Some(orbit) = &self.orbit {
            let field = field.at("orbit");
            field.at("radius_m").non_negative(orbit.radius_m)?;
            field.at("period_s").positive(orbit.period_s)?;
        }
        if let Some(log) = &self.log {
            let field = field.at("log");
            field.at("start_s").non_negative(log.start_s)?;
            if let Some(law) = self.law_beside_log() {
                return Err(field.refuse("no law of motion beside a flight log", law));
            }
        }
        self.telemetry.validate(&field.at("telemetry"))
    }

    fn law_beside_log(&self) -> Option<&'static str> {
        let laws = [
            ("sway", self.sway.is_some()),
            ("orbit", self.orbit.is_some()),
            ("velocity_m_s", self.velocity_m_s != [0.0; 3]),
            ("yaw_rate_deg_s", self.yaw_rate_deg_s != 0.0),
            ("heading_deg", self.heading_deg != 0.0),
        ];
        laws.into_iter().find(|(_, is_given)| *is_given).map(|(name, _)| name)
    }
}
