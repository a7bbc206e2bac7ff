//! One session with a device: negotiate a format, start the stream, take frames until a fault.

use std::io;
use std::path::Path;
use std::time::Duration;

use v4l::v4l_sys as c;

use super::Config;
use super::clock::Moment;
use super::faults::{Fault, Faults};
use super::image::{Granted, Layout, LayoutError, PixelFormat, fourcc_name};
use super::sys::{Format, Meta, Node, Stream};

/// Buffers requested: enough for a scheduling delay of a few frames.
const BUFFERS: u32 = 4;

/// Why a device could not be started.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    #[error("{call}: {source}")]
    Io { call: &'static str, source: io::Error },
    #[error("{card} ({driver}) does not capture video by streaming")]
    NoCapture { card: String, driver: String },
    #[error("asked for {asked}, the driver granted {granted}; it offers {offered}")]
    FormatRefused {
        asked: String,
        granted: String,
        offered: String,
    },
    #[error(transparent)]
    Layout(#[from] LayoutError),
}

impl StartError {
    pub fn fault(&self) -> Fault {
        match self {
            Self::Io { source, .. } => Fault::of(source),
            Self::NoCapture { .. } | Self::FormatRefused { .. } | Self::Layout(_) => Fault::FormatRefused,
        }
    }
}

/// A started device.
#[derive(Debug)]
pub struct Session {
    stream: Stream,
    layout: Layout,
    granted: Format,
    started: Moment,
    exposure: Duration,
}

impl Session {
    pub fn start(
        device: &Path,
        config: &Config,
        rate_hz: f64,
        shape: (usize, usize),
        faults: &mut Faults,
    ) -> Result<Self, StartError> {
        let io = |call| move |source| StartError::Io { call, source };
        let node = Node::open(device).map_err(io("open"))?;
        let capability = node.capability().clone();
        if !(capability.captures && capability.streams) {
            return Err(StartError::NoCapture {
                card: capability.card,
                driver: capability.driver,
            });
        }
        let (granted, format) = negotiate(&node, config)?;
        let layout = Layout::new(
            Granted {
                format,
                width: granted.width as usize,
                height: granted.height as usize,
                stride: granted.stride as usize,
            },
            config.region(),
            shape,
            [config.flip_x, config.flip_y],
            config.saturation_counts,
        )?;
        let granted_rate_hz = set_rate(&node, rate_hz, faults);
        let exposure = set_exposure(&node, config, faults);
        let gain = set_gain(&node, config, faults);
        tracing::info!(
            device = %device.display(),
            card = capability.card,
            driver = capability.driver,
            format = fourcc_name(granted.fourcc),
            width = granted.width,
            height = granted.height,
            stride = granted.stride,
            camera_pixels_per_pixel = layout.binned(),
            asked_rate_hz = rate_hz,
            rate_hz = granted_rate_hz,
            asked_exposure_us = config.exposure_us,
            exposure_us = exposure.map(|e| e.as_secs_f64() * 1e6),
            asked_gain = config.gain,
            gain,
            "the device is set up"
        );
        let started = Moment::now();
        Ok(Self {
            stream: Stream::start(node, BUFFERS).map_err(io("start"))?,
            layout,
            granted,
            started,
            exposure: exposure.unwrap_or_default(),
        })
    }

    pub fn wait(&self, patience: Duration) -> io::Result<bool> {
        self.stream.wait(patience)
    }

    pub fn next<T>(&mut self, look: impl FnOnce(&[u8], &Meta) -> T) -> io::Result<Option<T>> {
        self.stream.next(look)
    }

    pub fn layout(&self) -> Layout {
        self.layout
    }

    pub fn granted(&self) -> Format {
        self.granted
    }

    pub fn started(&self) -> Moment {
        self.started
    }

    pub fn exposure(&self) -> Duration {
        self.exposure
    }
}

/// The format that the driver really granted, if it is one we can use and as big as the config says.
fn negotiate(node: &Node, config: &Config) -> Result<(Format, PixelFormat), StartError> {
    let io = |call| move |source| StartError::Io { call, source };
    let offered = node.formats();
    let format = config.pixel_format.or_else(|| {
        PixelFormat::ALL
            .into_iter()
            .find(|f| offered.iter().any(|o| o.fourcc == f.fourcc()))
    });
    let current = node.format().map_err(io("get format"))?;
    let [width, height] = config.size.unwrap_or([current.width, current.height]);
    let fourcc = format.map_or(current.fourcc, PixelFormat::fourcc);
    let asked = Format {
        fourcc,
        width,
        height,
        ..current
    };
    let granted = node.set_format(asked).map_err(io("set format"))?;
    let size_differs = config.size.is_some() && [granted.width, granted.height] != [width, height];
    match PixelFormat::from_fourcc(granted.fourcc) {
        Some(usable) if granted.fourcc == fourcc && !size_differs => Ok((granted, usable)),
        _ => {
            let name = |f: Format| format!("{} {} × {}", fourcc_name(f.fourcc), f.width, f.height);
            let names: Vec<_> = offered.iter().map(|o| fourcc_name(o.fourcc)).collect();
            Err(StartError::FormatRefused {
                asked: name(asked),
                granted: name(granted),
                offered: names.join(", "),
            })
        }
    }
}

/// Asks for the frame rate and gives what the device then reports; `None` where it sets its own pace.
fn set_rate(node: &Node, asked_hz: f64, faults: &mut Faults) -> Option<f64> {
    match node.set_interval(1.0 / asked_hz) {
        Ok(granted_s) => granted_s.map(f64::recip),
        Err(error) => {
            faults.count(Fault::ControlRefused, format_args!("rate_hz = {asked_hz}: {error}"));
            None
        }
    }
}

/// Fixes the exposure time and gives what the device then reports.
fn set_exposure(node: &Node, config: &Config, faults: &mut Faults) -> Option<Duration> {
    /// The unit of V4L2_CID_EXPOSURE_ABSOLUTE.
    const UNIT_US: f64 = 100.0;
    let asked = config.exposure_us?;
    // Cameras without automatic exposure lack the switch.
    let manual = i64::from(c::v4l2_exposure_auto_type_V4L2_EXPOSURE_MANUAL);
    let _ = node.set_control(c::V4L2_CID_EXPOSURE_AUTO, manual);
    match node.set_control(c::V4L2_CID_EXPOSURE_ABSOLUTE, (asked / UNIT_US).round() as i64) {
        Ok(units) => Some(Duration::from_micros((units.max(0) as f64 * UNIT_US) as u64)),
        Err(error) => {
            faults.count(Fault::ControlRefused, format_args!("exposure_us = {asked}: {error}"));
            None
        }
    }
}

/// Fixes the gain and gives what the device then reports.
fn set_gain(node: &Node, config: &Config, faults: &mut Faults) -> Option<i64> {
    let asked = config.gain?;
    let _ = node.set_control(c::V4L2_CID_AUTOGAIN, 0);
    let set = node
        .set_control(c::V4L2_CID_ANALOGUE_GAIN, asked)
        .or_else(|_| node.set_control(c::V4L2_CID_GAIN, asked));
    match set {
        Ok(gain) => Some(gain),
        Err(error) => {
            faults.count(Fault::ControlRefused, format_args!("gain = {asked}: {error}"));
            None
        }
    }
}
