//! `oapwatch calibrate`: learns the calibration of a device from its frames, with or without known positions.

mod args;
mod blind;
mod picture;
mod surveyed;

pub use args::Args;

use std::path::PathBuf;

use anyhow::{Context, anyhow};

use super::{Failure, Outcome};
use crate::calibrate::file;
use crate::config::Config;

pub fn run(args: Args) -> Outcome {
    let is_svg = |path: &PathBuf| path.extension().is_some_and(|e| e == "svg");
    if let Some(path) = args.picture.as_ref().filter(|path| !is_svg(path)) {
        return Err(Failure::Other(anyhow!(
            "--picture: expected a file name that ends in .svg, found {}",
            path.display()
        )));
    }
    for path in std::iter::once(&args.out).chain(&args.picture) {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            return Err(Failure::Input(anyhow!(
                "{}: there is no folder {}",
                path.display(),
                folder.display()
            )));
        }
    }
    let mut config = Config::load_uncalibrated(&args.config).map_err(Failure::config)?;
    if let Some(path) = config.optics.calibration.take() {
        match file::read(&path) {
            Ok(calibration) => config.optics.calibrated = Some(calibration),
            // The file that this command will write.
            Err(file::Error::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(Failure::config(e)),
        }
    }
    let camera = config.optics.camera();
    let camera = camera
        .with_context(|| args.config.display().to_string())
        .map_err(Failure::Config)?;
    match &args.truth {
        Some(truth) => surveyed::run(&args, truth, &config, &camera),
        None => blind::run(&args, &camera),
    }
}
