//! `[source]`: which source of frames and its settings.

use std::path::PathBuf;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::Error;
use crate::scene::Scene;
use crate::toml_file::Key;

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
    /// Frames per second of the recording, or requested from the device; [`Config::DEFAULT_RATE_HZ`] when left out. A simulator
    /// runs at its scene's rate, and another one given here is refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Replay of a .npy file: how long each frame collected light, s; left out, spots are taken not to smear.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_s: Option<f64>,
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
            rate_hz: None,
            exposure_s: None,
            speed: 1.0,
            r#loop: false,
        }
    }
}

impl Config {
    /// Frames per second of a recording or device when `rate_hz` is left out.
    pub const DEFAULT_RATE_HZ: f64 = 10.0;

    /// Checks every number, whether the chosen source uses it or not.
    pub fn validate(&self) -> Result<(), Error> {
        let key = Key::new("source");
        if let Some(rate_hz) = self.rate_hz {
            key.at("rate_hz").within(
                rate_hz,
                1e-3..=1e5,
                "frames per second: from one in a quarter of an hour to faster than any camera",
            )?;
        }
        if let Some(exposure_s) = self.exposure_s {
            let reason = "seconds of exposure: from a microsecond to a quarter of an hour";
            key.at("exposure_s").within(exposure_s, 1e-6..=1e3, reason)?;
        }
        if self.speed != 0.0 {
            let reason = "times the original speed, or 0: as fast as possible";
            key.at("speed").within(self.speed, 1e-6..=1e6, reason)?;
        }
        self.v4l2.validate()
    }

    /// Frames per second that the source gives: of a simulator the scene's, otherwise those of `rate_hz`.
    ///
    /// # Errors
    /// The scene cannot be read.
    pub fn frame_rate_hz(&self) -> Result<f64, Error> {
        match self.kind {
            SourceKind::Simulator => match &self.scene {
                Some(path) => Ok(Scene::load(path)?.rate_hz),
                None => Ok(Scene::builtin().rate_hz),
            },
            SourceKind::V4l2 | SourceKind::Replay => Ok(self.rate_hz.unwrap_or(Self::DEFAULT_RATE_HZ)),
        }
    }

    /// Keys of `[source]` among `given` that the chosen kind of source does not use.
    pub fn unused<'a>(&self, given: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
        let used: &[&str] = match self.kind {
            SourceKind::Simulator => &["scene", "seed", "start"],
            SourceKind::V4l2 => &["device", "v4l2", "rate_hz"],
            SourceKind::Replay => &["frames", "start", "rate_hz", "exposure_s", "speed", "loop"],
        };
        given.filter(|key| *key != "kind" && !used.contains(key)).collect()
    }
}
