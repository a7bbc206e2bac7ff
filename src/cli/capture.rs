//! `oapwatch capture`: writes a camera's frames to a file, as the daemon would see them.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use jiff::Timestamp;
use ndarray::Array2;
use serde::Serialize;

use super::camera_source::{CameraSource, Unit};
use super::{Failure, Outcome, interrupt, progress};
use crate::api::frame_png;
use crate::frame::Frame;
use crate::frames::npy;
use crate::frames::v4l2::{Bayer, Transfer};
use crate::optics::Camera;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch capture --device /dev/video0 --frames 300 --out frames.npy\n  oapwatch capture --config oapwatch.toml --frames 100 --out dark.npy --dark"
)]
pub struct Args {
    /// The camera; with --config another than its own
    #[arg(long, required_unless_present = "config")]
    device: Option<PathBuf>,
    /// A config: its source, region and conversions, and joules. Without one the whole image in the best format, in counts
    #[arg(long)]
    config: Option<PathBuf>,
    /// How many frames
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    frames: u64,
    /// FRAMES.npy; its times and settings go to FRAMES.toml, a picture of the mean to FRAMES.png
    #[arg(long, value_name = "FRAMES.npy")]
    out: PathBuf,
    /// Frames without light, the lens covered: noted in FRAMES.toml
    #[arg(long)]
    dark: bool,
}

/// Of the picture's longer side, at least, in its pixels.
const PICTURE_SIDE: usize = 512;

pub fn run(args: Args) -> Outcome {
    if args.out.extension().is_none_or(|e| e != "npy") {
        let found = args.out.display();
        return Err(Failure::Input(anyhow!(
            "--out: expected a name that ends in .npy, found {found}"
        )));
    }
    let mut source = match (&args.config, &args.device) {
        (Some(config), device) => CameraSource::of_config(config, device.as_ref())?,
        (None, Some(device)) => CameraSource::of_device(device, None)?,
        (None, None) => return Err(Failure::Input(anyhow!("expected --device or --config, found neither"))),
    };
    let interrupted = interrupt::watch().map_err(Failure::other)?;
    let mut recording = Recording::create(&args.out, &source.camera, source.unit).map_err(Failure::other)?;
    let bar = progress::bar(args.frames, "frames");
    let ended = source.take(args.frames, &interrupted, |frame| {
        recording.push(frame).map_err(|error| error.to_string())?;
        bar.inc(1);
        Ok(())
    });
    bar.finish_and_clear();
    let kept = recording.times.len();
    if kept == 0 {
        recording.discard();
        let why = ended.err().unwrap_or_default();
        return Err(Failure::Other(anyhow!("no frame, and nothing was written: {why}")));
    }
    let about = About::new(&recording, &source, args.dark);
    recording
        .finish(&args.out, &source.camera, &about)
        .map_err(Failure::other)?;
    let (name, [nx, ny]) = (args.out.display(), about.pixels);
    if let Err(why) = ended {
        return Err(Failure::Other(anyhow!(
            "{why}: {kept} of {} frames were written to {name}, and the files are valid",
            args.frames
        )));
    }
    let rate = about.measured_rate_hz.unwrap_or_default();
    eprintln!("{kept} frames of {nx} × {ny} pixels at {rate:.1} Hz in {name}");
    Ok(())
}

/// Frames on their way to a file, which takes its name when they are complete.
struct Recording {
    part: PathBuf,
    writer: npy::Writer,
    unit: Unit,
    times: Vec<Timestamp>,
    first_index: Option<u64>,
    last_index: u64,
    /// Sum of all frames, for the picture.
    sum: Array2<f64>,
}

impl Recording {
    fn create(out: &Path, camera: &Camera, unit: Unit) -> Result<Self, npy::Error> {
        let part = out.with_extension("npy.part");
        let writer = match unit {
            Unit::Counts => npy::Writer::create_counts(&part, camera.shape())?,
            Unit::Joules | Unit::RealCounts => npy::Writer::create(&part, camera.shape())?,
        };
        Ok(Self {
            part,
            writer,
            unit,
            times: Vec::new(),
            first_index: None,
            last_index: 0,
            sum: Array2::zeros(camera.shape()),
        })
    }

    fn push(&mut self, frame: Frame) -> Result<(), npy::Error> {
        let mut pixels = frame.pixels;
        // A saturated count says so itself; joules have no such mark.
        if let Some(masked) = frame.masked.filter(|_| self.unit == Unit::Joules) {
            pixels.zip_mut_with(&masked, |pixel, masked| {
                if *masked {
                    *pixel = f64::NAN;
                }
            });
        }
        self.writer.push(pixels.view())?;
        self.sum += &pixels;
        self.times.push(frame.time);
        self.first_index.get_or_insert(frame.index);
        self.last_index = frame.index;
        Ok(())
    }

    fn discard(self) {
        // Best effort: there is nothing in it.
        let _ = std::fs::remove_file(&self.part);
    }

    /// Gives the frames their name, with the settings and the picture beside them.
    fn finish(mut self, out: &Path, camera: &Camera, about: &About) -> anyhow::Result<()> {
        self.writer.sync()?;
        std::fs::rename(&self.part, out).with_context(|| out.display().to_string())?;
        let text = toml::to_string(about).context("the settings as TOML")?;
        let head = "# Written by `oapwatch capture`.\n";
        replace(&out.with_extension("toml"), format!("{head}{text}").as_bytes())?;
        let frame = Frame {
            index: 0,
            time: self.times[0],
            pixels: self.sum / self.times.len() as f64,
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        replace(&out.with_extension("png"), &frame_png(&frame, camera, PICTURE_SIDE)?)
    }
}

/// Replaces a file in one step.
fn replace(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    std::fs::write(&part, bytes)
        .and_then(|()| std::fs::rename(&part, path))
        .with_context(|| path.display().to_string())
}

/// FRAMES.toml.
#[derive(Debug, Serialize)]
struct About {
    frames: usize,
    unit: Unit,
    dark: bool,
    /// Frames that the source numbered and that are not in the file, corrupt or lost on the way.
    lost: u64,
    /// Events without a usable frame.
    unusable: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    measured_rate_hz: Option<f64>,
    /// Nx, Ny of the array.
    pixels: [usize; 2],
    times: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    device: Option<Device>,
}

/// How the device stood at the end.
#[derive(Debug, Serialize)]
struct Device {
    path: PathBuf,
    card: String,
    driver: String,
    pixel_format: String,
    size: [usize; 2],
    #[serde(skip_serializing_if = "Option::is_none")]
    roi: Option<[usize; 4]>,
    flip_x: bool,
    flip_y: bool,
    bayer: Bayer,
    transfer: Transfer,
    limited_range: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    exposure_us: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gain: Option<i64>,
}

impl About {
    fn new(recording: &Recording, source: &CameraSource, dark: bool) -> Self {
        let (config, camera) = (&source.config, &source.camera);
        let times = &recording.times;
        let numbered = recording
            .first_index
            .map_or(0, |first| recording.last_index - first + 1);
        let (first, last) = (times[0], times[times.len() - 1]);
        let lasted_s = last.duration_since(first).as_secs_f64();
        let v4l2 = &config.v4l2;
        let device = source.settings().map(|settings| Device {
            path: config.device.clone().unwrap_or_default(),
            card: settings.card.clone(),
            driver: settings.driver.clone(),
            pixel_format: settings.image.format.name(),
            size: [settings.image.width, settings.image.height],
            roi: v4l2.roi,
            flip_x: v4l2.flip_x,
            flip_y: v4l2.flip_y,
            bayer: v4l2.bayer,
            transfer: v4l2.transfer,
            limited_range: v4l2.limited_range,
            rate_hz: settings.rate_hz,
            exposure_us: settings.exposure.map(|e| 1e6 * e.as_secs_f64()),
            gain: settings.gain,
        });
        Self {
            frames: times.len(),
            unit: recording.unit,
            dark,
            lost: numbered.saturating_sub(times.len() as u64),
            unusable: source.unusable,
            measured_rate_hz: (lasted_s > 0.0).then(|| (times.len() - 1) as f64 / lasted_s),
            pixels: [camera.x.n, camera.y.n],
            times: times.iter().map(Timestamp::to_string).collect(),
            device,
        }
    }
}
