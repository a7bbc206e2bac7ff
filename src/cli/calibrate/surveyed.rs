//! `oapwatch calibrate --truth`: fits the calibration of a device to frames with known positions.

use std::fmt::Display;
use std::io::Write;
use std::path::Path;

use anyhow::{Context, anyhow};
use ndarray::Array2;

use super::args::Args;
use super::{blind, picture};
use crate::calibrate::{self, Calibrated, file, truth};
use crate::cli::progress::Steps;
use crate::cli::{Failure, Outcome};
use crate::config::Config;
use crate::estimate;
use crate::frames::npy;
use crate::optics::Camera;

/// Most rejected lines of the truth file that the report names.
const NAMED: usize = 20;

pub fn run(args: &Args, truth_file: &Path, config: &Config, camera: &Camera) -> Outcome {
    let in_config = || args.config.display().to_string();
    let beacons = truth::read(truth_file).map_err(Failure::input)?;
    let frames = read_frames(args, truth_file, camera, &beacons)?;
    let list: Vec<(usize, &Array2<f64>)> = frames.iter().map(|(k, pixels)| (*k, pixels)).collect();

    let mut steps = Steps::unbounded();
    let mut progress = |p: &dyn Display| steps.next(&p.to_string());
    let mut build = |camera: &Camera| estimate::build(&config.estimator, camera);
    // Checked before the long fit.
    build(camera).with_context(in_config).map_err(Failure::Config)?;
    let outcome = calibrate::calibrate(camera, &list, &beacons, &mut build, &mut progress);
    steps.finish();
    let calibrated = outcome.map_err(|e| match e {
        calibrate::Error::TooLittle { .. } => {
            Failure::Input(anyhow::Error::new(e).context(truth_file.display().to_string()))
        }
        calibrate::Error::Estimator(e) => Failure::Config(anyhow::Error::new(e).context(in_config())),
        calibrate::Error::Unusable(_) => Failure::other(e),
    })?;
    if let (Some(path), Ok(learned)) = (&args.picture, &calibrated.spot) {
        picture::write(path, camera, learned)?;
    }
    let lines = report(camera, &calibrated);
    let mut out = std::io::stdout().lock();
    if !args.json {
        writeln!(out, "{}", lines.join("\n")).map_err(Failure::other)?;
    }
    let (before, after) = (calibrated.before, calibrated.after);
    if !(after.cost_m2 < before.cost_m2) {
        return Err(Failure::Other(anyhow!(
            "{} was not written: on the {} held-out positions the new calibration is no better \
             (mean squared error, misses counted as 25 m: {:.4} m² before, {:.4} m² after)",
            args.out.display(),
            before.beacons,
            before.cost_m2,
            after.cost_m2
        )));
    }
    if 2 * after.missed >= after.beacons {
        return Err(Failure::Other(anyhow!(
            "{} was not written: {} of the {} held-out positions have no emitter within 25 m; \
             does the truth belong to these frames?",
            args.out.display(),
            after.missed,
            after.beacons
        )));
    }
    if let Some(excess) = calibrated.unexplained_m2() {
        return Err(Failure::Other(anyhow!(
            "{} was not written: the held-out positions lie {:.3} m from the emitters (median), {:.3} m more than the noise \
             explains, and the calibration gained less than that ({:.3} m before); are the positions those of these frames, \
             each at its own time?",
            args.out.display(),
            after.median_m2.sqrt(),
            after.median_m2.sqrt() - (after.median_m2 - excess).max(0.0).sqrt(),
            before.median_m2.sqrt()
        )));
    }
    let mut remarks = vec!["Written by `oapwatch calibrate`; name it in [optics] calibration.".to_owned()];
    remarks.extend(lines);
    file::write(&args.out, &file::render(&calibrated.fitted.calibration, &remarks)).map_err(Failure::other)?;
    match args.json {
        true => writeln!(out, "{}", object(camera, &calibrated, &args.out)),
        false => writeln!(out, "written to {}", args.out.display()),
    }
    .map_err(Failure::other)
}

/// Reads the frames that have beacons.
fn read_frames(
    args: &Args,
    truth_file: &Path,
    camera: &Camera,
    beacons: &[truth::Beacon],
) -> Result<Vec<(usize, Array2<f64>)>, Failure> {
    let reader = npy::Reader::open(&args.frames, camera.joules_per_count).map_err(Failure::input)?;
    let (ny, nx) = reader.shape();
    if (ny, nx) != camera.shape() {
        return Err(Failure::Input(anyhow!(
            "{}: frames are {nx} × {ny} pixels, {} says {} × {}",
            args.frames.display(),
            args.config.display(),
            camera.x.n,
            camera.y.n
        )));
    }
    let total = reader.frames();
    let mut frames = Vec::new();
    for (k, pixels) in reader.enumerate() {
        let pixels = pixels.map_err(Failure::input)?;
        if beacons.iter().any(|b| b.frame == k) {
            frames.push((k, pixels));
        }
    }
    if frames.is_empty() {
        return Err(Failure::Input(anyhow!(
            "{}: no position belongs to any of the {total} frames of {}; its first is for frame {}",
            truth_file.display(),
            args.frames.display(),
            beacons.first().map_or(0, |b| b.frame)
        )));
    }
    Ok(frames)
}

/// The report as JSON.
fn object(camera: &Camera, c: &Calibrated, written: &Path) -> serde_json::Value {
    let (fitted, k) = (&c.fitted, &c.fitted.calibration);
    let lines: Vec<usize> = fitted.rejected.iter().map(|b| b.line).collect();
    serde_json::json!({
        "written": written.display().to_string(),
        "frames": c.frames,
        "positions_used": fitted.accepted.len(),
        "rejected_lines": lines,
        "unexplained_frames": fitted.unexplained,
        "reduced_chi2": fitted.reduced_chi2,
        "survey_std_m": fitted.survey_std_m,
        "geometry": {
            "principal_point_m": k.distortion.principal_point_m,
            "focal_scale": k.distortion.focal_scale,
            "radial": k.distortion.radial,
            "tangential": k.distortion.tangential,
        },
        "spot": c.spot.as_ref().ok().map(|learned| blind::shape_object(camera, learned)),
        "spot_sigma_m": k.spot_sigma_m,
        "spot_growth": k.spot_growth,
        "noise_std_j": k.noise_std_j,
        "bad_pixels": k.pixels.as_ref().map(|maps| maps.bad.iter().filter(|b| **b).count()),
        "before": c.before,
        "after": c.after,
    })
}

fn report(camera: &Camera, c: &Calibrated) -> Vec<String> {
    let fitted = &c.fitted;
    let k = &fitted.calibration;
    let d = &k.distortion;
    let mut lines = vec![format!(
        "{} frames, {} positions used, {} rejected, {} frames unexplained; reduced χ² {:.3}",
        c.frames,
        fitted.accepted.len(),
        fitted.rejected.len(),
        fitted.unexplained.len(),
        fitted.reduced_chi2
    )];
    if !fitted.rejected.is_empty() {
        let named: Vec<String> = fitted
            .rejected
            .iter()
            .take(NAMED)
            .map(|b| format!("{}", b.line))
            .collect();
        let more = fitted.rejected.len().saturating_sub(NAMED);
        let tail = if more > 0 {
            format!(" and {more} more")
        } else {
            String::new()
        };
        lines.push(format!("rejected positions are on lines {}{tail}", named.join(", ")));
    }
    if !fitted.unexplained.is_empty() {
        let named: Vec<String> = fitted.unexplained.iter().take(NAMED).map(usize::to_string).collect();
        lines.push(format!("unexplained frames: {}", named.join(", ")));
    }
    lines.push(format!(
        "principal point {:.4}, {:.4} mm; focal scale {:.6}; k1, k2, k3 {:.5}, {:.5}, {:.5}; p1, p2 {:.6}, {:.6}",
        1e3 * d.principal_point_m[0],
        1e3 * d.principal_point_m[1],
        d.focal_scale,
        d.radial[0],
        d.radial[1],
        d.radial[2],
        d.tangential[0],
        d.tangential[1]
    ));
    match &c.spot {
        Ok(learned) if learned.is_shape_better => lines.extend(blind::shape(camera, learned)),
        why => {
            lines.push(format!(
                "spot {:.5} mm on axis, {:+.2} % at the corner",
                1e3 * k.spot_sigma_m,
                1e2 * k.spot_growth
            ));
            lines.push(match why {
                Ok(_) => "no other shape of it explains the held-out frames better".to_owned(),
                Err(why) => format!("no other shape of it was learned: {why}"),
            });
        }
    }
    lines.push(format!(
        "noise {:.4e} J; positions scatter by {:.4} m beyond the noise",
        k.noise_std_j, fitted.survey_std_m
    ));
    lines.push(match &k.pixels {
        None => "too few frames for gain and dark maps".to_owned(),
        Some(maps) => {
            let n = maps.gain.len() as f64;
            let gain = (maps.gain.iter().map(|g| (g - 1.0).powi(2)).sum::<f64>() / n).sqrt();
            let bad = maps.bad.iter().filter(|b| **b).count();
            format!("gain scatter {:.3} % rms; bad pixels: {bad}", 1e2 * gain)
        }
    });
    for (name, s) in [("before", c.before), ("after", c.after)] {
        lines.push(format!(
            "{name}: held-out positions {}, missed {}, mean squared error of the found {:.5} m², median {:.5} m²",
            s.beacons, s.missed, s.mse_m2, s.median_m2
        ));
    }
    lines
}
