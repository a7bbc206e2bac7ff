//! Frames of the camera that is set up, and what they show.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use anyhow::anyhow;
use ndarray::Array2;

use crate::calibrate::first_look::{FirstLook, look};
use crate::calibrate::photon_transfer::mean_of;
use crate::cli::camera_source::{CameraSource, cell_of};
use crate::cli::{Failure, interrupt, progress};
use crate::frames::npy;
use crate::frames::v4l2::{self, Light, Response, Transfer};

/// Frames that are looked at.
const FRAMES: u64 = 100;
/// Fewest frames, however large they are.
const FEWEST: u64 = 10;
/// Pixels held in memory at a time, over all frames: 256 MB.
const MOST_PIXELS: u64 = 1 << 25;
/// Exposures that are tried begin here: half a frame interval of a fast camera.
const FIRST_EXPOSURE_US: f64 = 5000.0;
/// The brightest pixel is brought to between these shares of saturation.
const WELL_EXPOSED: std::ops::Range<f64> = 0.4..0.95;
/// A raw sensor's noise departs less than this from the line ([`crate::calibrate::photon_transfer::Gain::misfit`]); 8 bits and fixed
/// patterns reach half of it.
const STRAIGHT: f64 = 0.1;

/// A camera, its frames and what they show.
pub struct View {
    pub source: Viewed,
    /// Of the whole image, camera pixels.
    pub width: usize,
    pub height: usize,
    /// Camera pixels a side that make one of the pixels looked at.
    pub cell: usize,
    /// Of one of the pixels looked at.
    pub saturation_counts: f64,
    pub response: Response,
    /// Whether the curve was seen in the noise.
    pub response_seen: bool,
    pub look: FirstLook,
    /// The frames, counts in proportion to light.
    pub images: Vec<Array2<f64>>,
    /// Mean of the dark frames, where there are any.
    pub dark: Option<Array2<f64>>,
    pub rate_hz: Option<f64>,
}

/// Where the frames come from.
pub enum Viewed {
    Device {
        path: PathBuf,
        settings: v4l2::Settings,
    },
    Recording {
        path: PathBuf,
        /// Whether its numbers are counts.
        is_counts: bool,
    },
}

impl Viewed {
    /// What values are rounded to: counts to whole ones.
    pub fn step(&self) -> f64 {
        match self {
            Self::Recording { is_counts: false, .. } => 0.0,
            _ => 1.0,
        }
    }
}

impl View {
    pub fn of_device(device: &Path, dark: Option<&Path>) -> Result<Self, Failure> {
        let interrupted = interrupt::watch().map_err(Failure::other)?;
        let mut source = well_exposed(device, &interrupted)?;
        let (ny, nx) = source.camera.shape();
        let wanted = (MOST_PIXELS / (nx * ny) as u64).clamp(FEWEST, FRAMES);
        let (frames, rate_hz) = take(&mut source, wanted, &interrupted)?;
        let settings = source.settings().cloned();
        let settings = settings.ok_or_else(|| Failure::Other(anyhow!("{} was closed", device.display())))?;
        let (image, cell) = (settings.image, cell_of(settings.image));
        let white = white_of(image);
        let dark = read_dark(dark, (ny, nx))?;
        let by_driver = settings.response;
        let place = Viewed::Device {
            path: device.to_owned(),
            settings,
        };
        let likeliest = (image.format.light() == Light::Luma).then_some(by_driver);
        let (response, response_seen, look) = match likeliest {
            None => (Response::default(), true, look(&frames, white, &dark, place.step())),
            Some(likeliest) => straighten(&frames, white, &dark, likeliest),
        };
        Ok(Self {
            source: place,
            width: image.width,
            height: image.height,
            cell,
            saturation_counts: white,
            response,
            response_seen,
            look,
            dark: (!dark.is_empty()).then(|| mean_of(&linear(&dark, response, white))),
            images: linear(&frames, response, white),
            rate_hz,
        })
    }

    pub fn of_recording(path: &Path, dark: Option<&Path>, saturation: Option<f64>) -> Result<Self, Failure> {
        let (frames, is_counts) = read(path, None)?;
        let (ny, nx) = frames[0].dim();
        let dark = read_dark(dark, (ny, nx))?;
        let most = frames.iter().flatten().copied().fold(0.0, f64::max);
        let depth = [8, 10, 12, 14, 16].map(|bits| f64::from(1u32 << bits) - 1.0);
        let fewest_bits = depth.into_iter().find(|full| is_counts && *full >= most);
        let white = saturation.or(fewest_bits).unwrap_or(f64::INFINITY);
        let source = Viewed::Recording {
            path: path.to_owned(),
            is_counts,
        };
        Ok(Self {
            width: nx,
            height: ny,
            cell: 1,
            saturation_counts: white,
            // A replay undoes no curve.
            response: Response::default(),
            response_seen: true,
            look: look(&frames, white, &dark, source.step()),
            dark: (!dark.is_empty()).then(|| mean_of(&dark)),
            images: frames,
            rate_hz: captured_rate_hz(path),
            source,
        })
    }

    /// What somebody should see to before they rely on the config.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        let look = &self.look;
        if let Err(why) = &look.noise {
            warnings.push(format!("the noise was not measured: {why}"));
        }
        if let Some(misfit) = misfit(look).filter(|m| *m >= STRAIGHT) {
            warnings.push(format!(
                "the noise does not grow in line with the light (by {:.0} %): a curve, or the camera's own noise reduction or sharpening",
                100.0 * misfit
            ));
        }
        let is_dark = look.lit_share < 1e-3 && look.spots.is_empty() && look.saturated == 0;
        if is_dark {
            warnings.push(
                "no light above the noise: is the lens cap on? Gain and spot width could not be measured".to_owned(),
            );
        } else if look.lit_share > 0.3 {
            warnings.push(format!(
                "{:.0} % of the image is lit: what is not a beam will be taken for one. Darken the scene or use a filter for the beams' \
                 wavelength",
                100.0 * look.lit_share
            ));
        } else if look.spots.is_empty() {
            warnings.push("no spot stands apart unsaturated: its width could not be measured".to_owned());
        }
        if look.saturated > 0 {
            warnings.push(format!(
                "{} pixels are saturated: expose for a shorter time",
                look.saturated
            ));
        }
        if let Viewed::Device { settings, .. } = &self.source
            && settings.exposure.is_none()
        {
            warnings.push(
                "the camera does not let its exposure be set: energies hold only while it does not change by itself"
                    .to_owned(),
            );
        }
        if let Some(rate) = self.rate_hz.filter(|rate| *rate < 8.0) {
            warnings.push(format!("only {rate:.1} frames a second: alerts come later"));
        }
        warnings
    }
}

/// Full scale of one of the pixels looked at.
fn white_of(image: v4l2::Granted) -> f64 {
    f64::from(image.format.full_scale()) * cell_of(image).pow(2) as f64
}

fn misfit(look: &FirstLook) -> Option<f64> {
    Some(look.noise.as_ref().ok()?.gain?.misfit)
}

/// The curve of a video signal: the first with which noise grows in line with light, the likeliest before the others; where none does,
/// the likeliest. Whether it was seen, and the look through it.
fn straighten(
    frames: &[Array2<f64>],
    white: f64,
    dark: &[Array2<f64>],
    likeliest: Response,
) -> (Response, bool, FirstLook) {
    let through = |curve| {
        let straight = |frames: &[Array2<f64>]| linear(frames, curve, white);
        look(&straight(frames), white, &straight(dark), 1.0)
    };
    let is_straight = |look: &FirstLook| misfit(look).is_some_and(|m| m < STRAIGHT);
    let first = through(likeliest);
    if is_straight(&first) {
        return (likeliest, true, first);
    }
    for transfer in Transfer::ALL {
        for limited_range in [false, true] {
            let curve = Response {
                transfer,
                limited_range,
            };
            let look = through(curve);
            if curve != likeliest && is_straight(&look) {
                return (curve, true, look);
            }
        }
    }
    (likeliest, false, first)
}

/// Counts in proportion to light.
fn linear(frames: &[Array2<f64>], response: Response, white: f64) -> Vec<Array2<f64>> {
    match response.table(white.min(f64::from(u16::MAX)) as u16) {
        None => frames.to_vec(),
        Some(table) => frames
            .iter()
            .map(|frame| frame.mapv(|count| table.get(count as usize).copied().unwrap_or(count)))
            .collect(),
    }
}

/// The device at an exposure that brings its brightest pixel well below saturation, as far as it lets itself be set.
fn well_exposed(device: &Path, interrupted: &AtomicBool) -> Result<CameraSource, Failure> {
    const TRIES: usize = 12;
    const LOOK_AT: u64 = 3;
    let mut exposure_us = FIRST_EXPOSURE_US;
    let mut last_us = 0.0;
    for _ in 0..TRIES {
        let mut source = CameraSource::of_device(device, Some(exposure_us))?;
        let mut brightest = 0.0f64;
        let taken = source.take(LOOK_AT, interrupted, |frame| {
            let saturated = frame.masked.is_some();
            let most = frame.pixels.iter().copied().fold(0.0, f64::max);
            brightest = brightest.max(if saturated { f64::INFINITY } else { most });
            Ok(())
        });
        taken.map_err(|why| Failure::Other(anyhow!("{}: {why}", device.display())))?;
        let Some(settings) = source.settings() else {
            return Ok(source);
        };
        let share = brightest / white_of(settings.image);
        let granted_us = settings.exposure.map(|e| 1e6 * e.as_secs_f64());
        // A device that does not follow, or no further, stays as it is.
        if WELL_EXPOSED.contains(&share) || granted_us.is_none_or(|us| us == last_us) {
            return Ok(source);
        }
        last_us = granted_us.unwrap_or_default();
        let factor = if share.is_finite() {
            (0.7 / share.max(0.01)).min(4.0)
        } else {
            0.25
        };
        exposure_us = (last_us * factor).clamp(1.0, 1e6 / crate::frames::Config::DEFAULT_RATE_HZ);
    }
    CameraSource::of_device(device, Some(exposure_us))
}

/// Frames of the device, saturated pixels at full scale, and its rate.
fn take(
    source: &mut CameraSource,
    wanted: u64,
    interrupted: &AtomicBool,
) -> Result<(Vec<Array2<f64>>, Option<f64>), Failure> {
    let bar = progress::bar(wanted, "frames");
    let (mut frames, mut times) = (Vec::new(), Vec::new());
    let white = source.settings().map_or(f64::INFINITY, |s| white_of(s.image));
    let ended = source.take(wanted, interrupted, |frame| {
        let mut pixels = frame.pixels;
        if let Some(saturated) = frame.masked {
            pixels.zip_mut_with(&saturated, |pixel, saturated| {
                if *saturated {
                    *pixel = white;
                }
            });
        }
        frames.push(pixels);
        times.push(frame.time);
        bar.inc(1);
        Ok(())
    });
    bar.finish_and_clear();
    if let Err(why) = ended
        && (frames.len() as u64) < FEWEST
    {
        let found = frames.len();
        return Err(Failure::Other(anyhow!(
            "{why}: {found} frames came, expected at least {FEWEST}"
        )));
    }
    let lasted_s = times[times.len() - 1].duration_since(times[0]).as_secs_f64();
    let rate = (lasted_s > 0.0).then(|| (times.len() - 1) as f64 / lasted_s);
    Ok((frames, rate))
}

/// The rate that `oapwatch capture` noted beside a recording.
fn captured_rate_hz(frames: &Path) -> Option<f64> {
    let text = std::fs::read_to_string(frames.with_extension("toml")).ok()?;
    text.parse::<toml::Table>().ok()?.get("measured_rate_hz")?.as_float()
}

/// Frames without light; none where no file is named.
fn read_dark(path: Option<&Path>, shape: (usize, usize)) -> Result<Vec<Array2<f64>>, Failure> {
    path.map_or(Ok(Vec::new()), |path| Ok(read(path, Some(shape))?.0))
}

/// The first frames of a recording, and whether they are counts.
fn read(path: &Path, shape: Option<(usize, usize)>) -> Result<(Vec<Array2<f64>>, bool), Failure> {
    let reader = npy::Reader::open(path, Some(1.0)).map_err(Failure::input)?;
    let (ny, nx) = reader.shape();
    if let Some((expected_y, expected_x)) = shape.filter(|shape| *shape != (ny, nx)) {
        let shown = path.display();
        return Err(Failure::Input(anyhow!(
            "{shown}: frames are {nx} × {ny} pixels, those with light {expected_x} × {expected_y}"
        )));
    }
    let is_counts = reader.is_counts();
    let wanted = (MOST_PIXELS / (nx * ny) as u64).clamp(FEWEST, FRAMES) as usize;
    let frames: Result<Vec<_>, _> = reader.take(wanted).collect();
    let frames = frames.map_err(Failure::input)?;
    if frames.is_empty() {
        return Err(Failure::Input(anyhow!("{}: no frames", path.display())));
    }
    Ok((frames, is_counts))
}
