//! `[source]`: which source of frames and its settings.

use std::path::PathBuf;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// `[source]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub kind: SourceKind,
    /// Simulator: a scene file; the built-in scene when left out.
    pub scene: Option<PathBuf>,
    /// Simulator: the same seed gives the same beams and noise.
    pub seed: u64,
    /// V4L2: the device node.
    pub device: Option<PathBuf>,
    /// V4L2: what to ask of the camera.
    pub v4l2: super::v4l2::Config,
    /// Replay: the recording.
    pub frames: Option<PathBuf>,
    /// The time of frame 0. Replay: frame k is at start + k/rate_hz whatever the speed. Simulator: now when left out.
    pub start: Option<Timestamp>,
    /// Frames per second of the recording, or asked of the device.
    pub rate_hz: f64,
    /// Replay: 1 = as recorded, 0 = as fast as possible.
    pub speed: f64,
    /// Replay: start again at the end.
    pub r#loop: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SourceKind {
    #[default]
    Simulator,
    V4l2,
    Replay,
}

impl SourceKind {
    pub fn name(self) -> &'static str {
        match self {
            Self::Simulator => "simulator",
            Self::V4l2 => "v4l2",
            Self::Replay => "replay",
        }
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            kind: SourceKind::Simulator,
            scene: None,
            seed: 0,
            device: None,
            v4l2: super::v4l2::Config::default(),
            frames: None,
            start: None,
            rate_hz: 10.0,
            speed: 1.0,
            r#loop: false,
        }
    }
}
