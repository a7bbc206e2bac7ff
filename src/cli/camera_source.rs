//! The source of frames for commands that look at a camera: a device in counts, or what a config says.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use serde::Serialize;

use super::Failure;
use crate::config::Config;
use crate::frame::Frame;
use crate::frames::v4l2::{self, Granted, Light, Settings, V4l2};
use crate::frames::{self, FrameSource, Next, SourceKind};
use crate::optics::{self, Camera};

/// Without a usable frame for this long there are no more.
const PATIENCE: Duration = Duration::from_secs(10);
/// How often an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(100);

/// What a pixel's value is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    Joules,
    /// Whole numbers of 16 bits.
    Counts,
    /// Counts that 16 bits do not hold.
    #[serde(rename = "counts")]
    RealCounts,
}

/// A source with the config and camera that it runs by.
pub struct CameraSource {
    pub config: frames::Config,
    pub camera: Camera,
    pub unit: Unit,
    frames: Frames,
    /// Events without a usable frame so far.
    pub unusable: u64,
}

/// A device also says how it is set.
enum Frames {
    Device(Box<V4l2>),
    Other(Box<dyn FrameSource>),
}

impl CameraSource {
    /// The source of a config, or another device in its place.
    pub fn of_config(path: &Path, device: Option<&PathBuf>) -> Result<Self, Failure> {
        let mut config = Config::load(path).map_err(Failure::config)?;
        if let Some(device) = device {
            config.source.kind = SourceKind::V4l2;
            config.source.device = Some(device.clone());
        }
        let camera = config.camera().map_err(Failure::config)?;
        Self::open(config.source, camera, Unit::Joules)
    }

    /// All of a device's image in the best format, in counts; of a Bayer image sums of 2 × 2. Without an exposure time it stays as
    /// the device has it.
    pub fn of_device(device: &Path, exposure_us: Option<f64>) -> Result<Self, Failure> {
        let mut source = frames::Config {
            kind: SourceKind::V4l2,
            device: Some(device.to_owned()),
            ..frames::Config::default()
        };
        let granted = v4l2::probe(device, &source.v4l2, frames::Config::DEFAULT_RATE_HZ)
            .with_context(|| device.display().to_string())
            .map_err(Failure::Input)?;
        // What was granted once is asked for from now on.
        source.v4l2.pixel_format = Some(granted.format);
        source.v4l2.size = Some([granted.width as u32, granted.height as u32]);
        source.v4l2.exposure_us = exposure_us;
        let cell = cell_of(granted);
        let optics = optics::Config {
            pixels: [granted.width / cell, granted.height / cell],
            joules_per_count: Some(1.0),
            ..optics::Config::default()
        };
        let most = u64::from(granted.format.full_scale()) * (cell * cell) as u64;
        let unit = match most <= u16::MAX.into() {
            true => Unit::Counts,
            false => Unit::RealCounts,
        };
        let camera = optics.camera().map_err(Failure::config)?;
        Self::open(source, camera, unit)
    }

    fn open(config: frames::Config, camera: Camera, unit: Unit) -> Result<Self, Failure> {
        let frames = match config.kind {
            SourceKind::V4l2 => V4l2::new(&config, &camera).map(|v| Frames::Device(Box::new(v))),
            _ => frames::open(&config, &camera).map(Frames::Other),
        };
        Ok(Self {
            frames: frames.map_err(Failure::config)?,
            config,
            camera,
            unit,
            unusable: 0,
        })
    }

    /// How the device stands, while it is open.
    pub fn settings(&self) -> Option<&Settings> {
        match &self.frames {
            Frames::Device(device) => device.settings(),
            Frames::Other(_) => None,
        }
    }

    /// Hands on up to `frames` frames.
    ///
    /// # Errors
    /// Why there are fewer: an interrupt, the end of a recording, no usable frame for [`PATIENCE`], or what `take` says.
    pub fn take(
        &mut self,
        frames: u64,
        interrupted: &AtomicBool,
        mut take: impl FnMut(Frame) -> Result<(), String>,
    ) -> Result<(), String> {
        let mut last_usable = Instant::now();
        let mut trouble = "no frame came".to_owned();
        let mut taken = 0;
        while taken < frames {
            if interrupted.load(Ordering::Relaxed) {
                return Err("interrupted".to_owned());
            }
            let next = match &mut self.frames {
                Frames::Device(device) => device.next(GLANCE),
                Frames::Other(other) => other.next(GLANCE),
            };
            match next {
                Next::Frame(frame, _) => {
                    take(frame)?;
                    taken += 1;
                    last_usable = Instant::now();
                }
                Next::Unusable { reason, .. } => {
                    self.unusable += 1;
                    trouble = reason;
                }
                Next::Nothing => {}
                Next::End => return Err("the recording has ended".to_owned()),
            }
            if last_usable.elapsed() > PATIENCE {
                return Err(trouble);
            }
        }
        Ok(())
    }
}

/// Camera pixels a side that make one sample of all light: 2 behind a Bayer filter.
pub fn cell_of(granted: Granted) -> usize {
    if granted.format.light() == Light::Bayer { 2 } else { 1 }
}
