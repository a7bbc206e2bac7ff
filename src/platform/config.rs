//! `[platform]`: where poses come from, and how the camera is mounted.

use std::path::PathBuf;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::mavlink::{Endpoint, EndpointError, KeyError, Settings, Signing};
use crate::pose::{Mount, PoseSigmas};

/// `[platform]`: the platform that the camera is mounted on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub kind: Kind,
    /// Where an autopilot's messages come from.
    pub endpoint: Option<String>,
    /// The autopilot's system id; left out, that of the first autopilot that is heard.
    pub system_id: Option<u8>,
    /// The key with which the autopilot's frames are signed; left out, signatures are not checked.
    pub signing_key_file: Option<PathBuf>,
    /// Asks the autopilot for poses at this rate; left out, it sends what it is configured to send.
    pub request_hz: Option<f64>,
    /// NDJSON file of poses, or a flight log of PX4 (`.ulg`).
    pub poses: Option<PathBuf>,
    /// The time of a flight log's first attitude; left out, by the log's GNSS time.
    pub poses_start: Option<Timestamp>,
    /// The camera's attitude in the body.
    pub mount: Mount,
    /// Pose stamps minus frame stamps, s; left out, unknown to within some tens of milliseconds.
    pub delay_s: Option<f64>,
    /// Age of the newest pose from which on an alert says that poses are lost, s.
    pub pose_lost_s: f64,
}

/// Where poses come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Level, heading north, over (0, 0) at `[optics] altitude_m`.
    #[default]
    Fixed,
    Mavlink,
    Replay,
    /// With the frames: of the simulator, or of a recording that holds them.
    Frames,
}

impl Kind {
    pub fn name(self) -> &'static str {
        match self {
            Self::Fixed => "fixed",
            Self::Mavlink => "mavlink",
            Self::Replay => "replay",
            Self::Frames => "frames",
        }
    }
}

/// Why a `[platform]` table cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("platform.{field}: expected {expected}, found {found}")]
    Range {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error("platform.endpoint: {0}")]
    Endpoint(#[from] EndpointError),
    #[error("platform.signing_key_file: {0}")]
    Key(#[from] KeyError),
    #[error("platform.{field}: expected {expected} with platform.kind = {kind:?}, found nothing")]
    Missing {
        field: &'static str,
        expected: &'static str,
        kind: &'static str,
    },
}

impl Default for Config {
    fn default() -> Self {
        Self {
            kind: Kind::Fixed,
            endpoint: None,
            system_id: None,
            signing_key_file: None,
            request_hz: None,
            poses: None,
            poses_start: None,
            mount: Mount::default(),
            delay_s: None,
            pose_lost_s: 1.0,
        }
    }
}

impl Config {
    /// Checks every number, and that what the kind needs is there.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let check = |ok: bool, field, expected, found| match ok {
            true => Ok(()),
            false => Err(ConfigError::Range { field, expected, found }),
        };
        for (field, angle) in [
            ("mount.roll_deg", self.mount.roll_deg),
            ("mount.pitch_deg", self.mount.pitch_deg),
            ("mount.yaw_deg", self.mount.yaw_deg),
        ] {
            check(angle.abs() <= 360.0, field, "-360 to 360 (degrees)", angle)?;
        }
        if let Some(delay) = self.delay_s {
            check(delay.abs() <= 10.0, "delay_s", "within 10 seconds either way", delay)?;
        }
        let lost = self.pose_lost_s;
        check(
            (0.05..=3600.0).contains(&lost),
            "pose_lost_s",
            "0.05 to 3600 (seconds)",
            lost,
        )?;
        if let Some(system) = self.system_id {
            check(system > 0, "system_id", "1 to 255", system.into())?;
        }
        if let Some(rate) = self.request_hz {
            check(
                (1.0..=200.0).contains(&rate),
                "request_hz",
                "1 to 200 (per second)",
                rate,
            )?;
        }
        self.endpoint()?;
        let kind = self.kind.name();
        let missing = |field, expected| Err(ConfigError::Missing { field, expected, kind });
        match self.kind {
            Kind::Mavlink if self.endpoint.is_none() => missing("endpoint", "such as \"udpin:127.0.0.1:14550\""),
            Kind::Replay if self.poses.is_none() => missing("poses", "a file of poses"),
            _ => Ok(()),
        }
    }

    /// The autopilot to listen to; none where poses come from elsewhere. Reads the key.
    pub fn telemetry(&self) -> Result<Option<Settings>, ConfigError> {
        let Some(endpoint) = self.endpoint()?.filter(|_| self.kind == Kind::Mavlink) else {
            return Ok(None);
        };
        let key = self.signing_key_file.as_deref();
        Ok(Some(Settings {
            endpoint,
            system_id: self.system_id,
            signing: key.map(Signing::from_file).transpose()?,
            sigmas: PoseSigmas::default(),
            request_hz: self.request_hz,
        }))
    }

    fn endpoint(&self) -> Result<Option<Endpoint>, EndpointError> {
        self.endpoint.as_deref().map(str::parse).transpose()
    }
}
