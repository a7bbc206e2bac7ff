//! `oapwatch setup`: looks at a camera and writes a config for it.

mod new_config;
mod questions;
mod shape;
mod view;

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};

use super::{Failure, Outcome};
use crate::calibrate::file;
use crate::config::Config;
use new_config::NewConfig;
use questions::Geometry;
use shape::Shape;
use view::View;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch setup --device /dev/video0 --altitude-m 120 --field-of-view-deg 60 --out oapwatch.toml\n  oapwatch setup --frames frames.npy --dark dark.npy --altitude-m 120 --focal-length-m 0.012 --pixel-pitch-m 3.45e-6 --out oapwatch.toml"
)]
pub struct Args {
    /// The camera
    #[arg(long, conflicts_with = "frames", required_unless_present = "frames")]
    device: Option<PathBuf>,
    /// A recording in counts in place of the camera; the config replays it
    #[arg(long, value_name = "FRAMES.npy")]
    frames: Option<PathBuf>,
    /// A recording without light, as `oapwatch capture --dark` writes it: dark level and bad pixels come from it
    #[arg(long, value_name = "DARK.npy")]
    dark: Option<PathBuf>,
    /// Where to write the config; what it cannot hold goes to a calibration file beside it
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    geometry: questions::Args,
    /// Count from which a pixel of the recording is saturated; the largest of the fewest bits that hold it when left out
    #[arg(long, value_name = "COUNTS", value_parser = counts)]
    saturation_counts: Option<f64>,
}

fn counts(text: &str) -> Result<f64, String> {
    let counts = text
        .parse::<f64>()
        .ok()
        .filter(|counts| *counts > 0.0 && counts.is_finite());
    counts.ok_or_else(|| "expected a number above 0".to_owned())
}

/// First line of a config written here; one without it belongs to the user and is kept.
const HEAD: &str = "# Written by `oapwatch setup`";

pub fn run(args: Args) -> Outcome {
    refuse_foreign(&args.out)?;
    let geometry = Geometry::ask(&args.geometry)?;
    let view = match (&args.device, &args.frames) {
        (Some(device), _) => View::of_device(device, args.dark.as_deref())?,
        (None, Some(frames)) => View::of_recording(frames, args.dark.as_deref(), args.saturation_counts)?,
        (None, None) => return Err(Failure::Input(anyhow!("expected --device or --frames, found neither"))),
    };
    let mut new = NewConfig::new(&view, &geometry);
    let shape = Shape::learn(&view, &new, new.camera().map_err(Failure::input)?);
    if let Some(sigma_m) = shape.sigma_m() {
        new.spot_sigma_m = sigma_m;
    }
    let calibration_path = args.out.with_extension("calibration.toml");
    let camera = new.camera().map_err(Failure::input)?;
    let maps = new.calibration(&view, &camera).map_err(Failure::other)?;
    let calibration = shape.calibration(&camera, maps)?;
    if let Some(calibration) = &calibration {
        let remark = "Written by `oapwatch setup`: dark levels, bad pixels, the spot's shape.".to_owned();
        file::write(&calibration_path, &file::render(calibration, &[remark])).map_err(Failure::other)?;
    }
    let name = calibration
        .and(calibration_path.file_name())
        .map(|n| n.to_string_lossy().into_owned());
    write(&args.out, &new.text(HEAD, &view, &geometry, name.as_deref())).map_err(Failure::Other)?;
    // What is written must be what `run` takes.
    let written = Config::load(&args.out).map_err(Failure::config)?;
    written.camera().map_err(Failure::config)?;
    let mut out = std::io::stdout().lock();
    for line in new.report(&view).into_iter().chain(shape.report()) {
        writeln!(out, "{line}").map_err(Failure::other)?;
    }
    let shown = args.out.display();
    writeln!(out, "written to {shown}; `oapwatch run --config {shown}` uses it").map_err(Failure::other)?;
    for warning in view.warnings() {
        eprintln!("oapwatch: {warning}");
    }
    Ok(())
}

/// A file of another origin is kept.
fn refuse_foreign(out: &Path) -> Result<(), Failure> {
    let shown = out.display();
    match std::fs::read_to_string(out) {
        Ok(text) if text.starts_with(HEAD) => Ok(()),
        Ok(_) => Err(Failure::Input(anyhow!(
            "--out: {shown} is there and was not written by `oapwatch setup`; name another file or remove it"
        ))),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        Err(error) => Err(Failure::Input(
            anyhow::Error::new(error).context(format!("--out: {shown}")),
        )),
    }
}

/// Replaces the config in one step.
fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    let part = path.with_extension("toml.part");
    std::fs::write(&part, text)
        .and_then(|()| std::fs::rename(&part, path))
        .with_context(|| path.display().to_string())
}
