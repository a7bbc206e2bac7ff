//! One session with a device: negotiate a format, start the stream, take frames until a fault.

use std::io;
use std::path::Path;
use std::time::Duration;

use v4l::v4l_sys as c;

use super::Config;
use super::clock::Moment;
use super::faults::{Fault, Faults};
use super::format::{Light, PixelFormat, fourcc_name};
use super::image::{Counts, DecodeError, Granted, Layout, LayoutError};
use super::ranking::{Offer, rank};
use super::response::{Response, Transfer};
use super::sys::{Colour, Format, Meta, Node, Stream};

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
    settings: Settings,
}

/// What a device is and how it stands after its start.
#[derive(Clone, Debug)]
pub struct Settings {
    pub card: String,
    pub driver: String,
    pub image: Granted,
    /// The curve that the driver names; a driver that names none means that of the colour space.
    pub response: Response,
    /// As the device reports it, where it does.
    pub rate_hz: Option<f64>,
    /// As asked for and granted; `None` as the driver has it.
    pub exposure: Option<Duration>,
    pub gain: Option<i64>,
}

impl Session {
    pub fn start(
        device: &Path,
        config: &Config,
        rate_hz: f64,
        shape: (usize, usize),
        faults: &mut Faults,
    ) -> Result<Self, StartError> {
        let node = open(device)?;
        let capability = node.capability().clone();
        let (granted, format) = negotiate(&node, config, rate_hz, Some(shape))?;
        let image = Granted::of(granted, format);
        let layout = Layout::new(image, &config.decoding(shape))?;
        let granted_rate_hz = set_rate(&node, rate_hz, faults);
        let exposure = config.exposure_us.and_then(|us| set_exposure(&node, us, faults));
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
            stream: Stream::start(node, BUFFERS).map_err(|source| StartError::Io { call: "start", source })?,
            layout,
            granted,
            started,
            settings: Settings {
                card: capability.card,
                driver: capability.driver,
                image,
                response: response_of(granted.colour, format),
                rate_hz: granted_rate_hz,
                exposure,
                gain,
            },
        })
    }

    pub fn wait(&self, patience: Duration) -> io::Result<bool> {
        self.stream.wait(patience)
    }

    /// The next frame's counts; `None` when there is no frame.
    pub fn next(&mut self) -> io::Result<Option<(Result<Counts, DecodeError>, Meta)>> {
        let layout = &self.layout;
        self.stream.next(|image, meta| (layout.decode(image), *meta))
    }

    /// Sets another exposure while frames come, and gives what the device then reports.
    pub fn set_exposure(&mut self, asked_us: f64, faults: &mut Faults) -> Option<Duration> {
        let granted = set_exposure(self.stream.node(), asked_us, faults);
        if granted.is_some() {
            self.settings.exposure = granted;
        }
        granted
    }

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub fn granted(&self) -> Format {
        self.granted
    }

    pub fn started(&self) -> Moment {
        self.started
    }

    pub fn exposure(&self) -> Duration {
        self.settings.exposure.unwrap_or_default()
    }
}

impl Granted {
    fn of(granted: Format, format: PixelFormat) -> Self {
        Self {
            format,
            width: granted.width as usize,
            height: granted.height as usize,
            stride: granted.stride as usize,
        }
    }
}

/// The curve of a video signal by the driver's word (the kernel's videodev2.h, V4L2_MAP_XFER_FUNC_DEFAULT and
/// V4L2_MAP_QUANTIZATION_DEFAULT). Raw formats have none.
fn response_of(colour: Colour, format: PixelFormat) -> Response {
    const JPEG: u32 = 7;
    const SRGB: u32 = 8;
    const RAW: u32 = 11;
    const FULL_RANGE: u32 = 1;
    if format.light() != Light::Luma {
        return Response::default();
    }
    let transfer = match (colour.transfer, colour.space) {
        (5, _) | (0, RAW) => Transfer::Linear,
        (2, _) | (0, JPEG | SRGB) => Transfer::Srgb,
        _ => Transfer::Bt709,
    };
    let is_full = match colour.quantisation {
        0 => colour.space == JPEG,
        quantisation => quantisation == FULL_RANGE,
    };
    Response {
        transfer,
        // JPEG has no other range.
        limited_range: !is_full && !format.is_compressed(),
    }
}

/// A node that captures.
fn open(device: &Path) -> Result<Node, StartError> {
    let node = Node::open(device).map_err(|source| StartError::Io { call: "open", source })?;
    let capability = node.capability();
    match capability.captures && capability.streams {
        true => Ok(node),
        false => Err(StartError::NoCapture {
            card: capability.card.clone(),
            driver: capability.driver.clone(),
        }),
    }
}

/// The image that a device would give, for a config that does not name the array's pixels yet.
pub fn probe(device: &Path, config: &Config, rate_hz: f64) -> Result<Granted, StartError> {
    let (granted, format) = negotiate(&open(device)?, config, rate_hz, None)?;
    Ok(Granted::of(granted, format))
}

/// What a node offers and can be used, the best first. `wished` is taken where the node lists no sizes or a range of them.
pub(super) fn offers(node: &Node, wished: [u32; 2], rate_hz: f64) -> Vec<Offer> {
    let mut offers = Vec::new();
    for format in node.formats() {
        let Some(format) = PixelFormat::from_fourcc(format.fourcc) else {
            continue;
        };
        let listed = node.sizes(format.fourcc());
        let mut sizes: Vec<[u32; 2]> = match listed.is_empty() {
            true => vec![wished],
            false => listed.iter().map(|sizes| sizes.choice(wished)).collect(),
        };
        sizes.dedup();
        offers.extend(sizes.into_iter().map(|size| Offer {
            format,
            size,
            rate_hz: node.fastest_hz(format.fourcc(), size),
        }));
    }
    rank(&mut offers, rate_hz);
    offers
}

/// The format that the driver really granted, if it is one we can use and as big as the config says.
fn negotiate(
    node: &Node,
    config: &Config,
    rate_hz: f64,
    shape: Option<(usize, usize)>,
) -> Result<(Format, PixelFormat), StartError> {
    let io = |call| move |source| StartError::Io { call, source };
    let current = node.format().map_err(io("get format"))?;
    let asked = choose(node, config, rate_hz, shape, current);
    let granted = node.set_format(asked).map_err(io("set format"))?;
    let size_differs = config.size.is_some() && [granted.width, granted.height] != [asked.width, asked.height];
    match PixelFormat::from_fourcc(granted.fourcc) {
        Some(usable) if granted.fourcc == asked.fourcc && !size_differs => Ok((granted, usable)),
        _ => {
            let name = |f: Format| format!("{} {} × {}", fourcc_name(f.fourcc), f.width, f.height);
            let names: Vec<_> = node.formats().iter().map(|o| fourcc_name(o.fourcc)).collect();
            Err(StartError::FormatRefused {
                asked: name(asked),
                granted: name(granted),
                offered: names.join(", "),
            })
        }
    }
}

/// The best of what a node offers within the config. A region of interest belongs to one size: without `size`, that in use.
fn choose(node: &Node, config: &Config, rate_hz: f64, shape: Option<(usize, usize)>, current: Format) -> Format {
    let in_use = [current.width, current.height];
    let only = config.size.or(config.roi.map(|_| in_use));
    let mut listed = offers(node, only.unwrap_or(in_use), rate_hz);
    listed.retain(|o| config.pixel_format.is_none_or(|f| o.format == f));
    let format = listed.first().map(|o| o.format).or(config.pixel_format);
    listed.retain(|o| only.is_none_or(|size| o.size == size));
    let fits = |offer: &&Offer| {
        let image = Granted {
            format: offer.format,
            width: offer.size[0] as usize,
            height: offer.size[1] as usize,
            stride: 0,
        };
        shape.is_none_or(|shape| Layout::new(image, &config.decoding(shape)).is_ok())
    };
    let best = listed.iter().find(fits).or(listed.first());
    let [width, height] = best.map_or(only.unwrap_or(in_use), |o| o.size);
    let format = best.map(|o| o.format).or(format);
    Format {
        fourcc: format.map_or(current.fourcc, PixelFormat::fourcc),
        width,
        height,
        ..current
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
fn set_exposure(node: &Node, asked: f64, faults: &mut Faults) -> Option<Duration> {
    /// The unit of V4L2_CID_EXPOSURE_ABSOLUTE.
    const UNIT_US: f64 = 100.0;
    // Cameras without automatic exposure lack the switch.
    let manual = i64::from(c::v4l2_exposure_auto_type_V4L2_EXPOSURE_MANUAL);
    let _ = node.set_control(c::V4L2_CID_EXPOSURE_AUTO, manual);
    match node.set_control(c::V4L2_CID_EXPOSURE_ABSOLUTE, (asked / UNIT_US).round().max(1.0) as i64) {
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
