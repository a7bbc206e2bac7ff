//! `oapwatch calibrate` without `--truth`: learns the spot's shape, the noise and the pixels from frames of unknown positions.

use std::io::Write;

use anyhow::{Context, anyhow};
use ndarray::Array2;

use super::args::Args;
use super::picture;
use crate::calibrate::file;
use crate::calibrate::spot::{self, Error, Learned};
use crate::cli::progress::Steps;
use crate::cli::{Failure, Outcome};
use crate::frames::{npy, record};
use crate::optics::Camera;

pub fn run(args: &Args, camera: &Camera) -> Outcome {
    let frames = read(args, camera)?;
    let list: Vec<(usize, &Array2<f64>)> = frames.iter().enumerate().collect();
    let mut steps = Steps::unbounded();
    let learned = spot::learn(camera, &list, &mut |p| steps.next(&p.to_string()));
    steps.finish();
    let learned =
        learned.map_err(|e: Error| Failure::Input(anyhow::Error::new(e).context(args.frames.display().to_string())))?;
    if let Some(path) = &args.picture {
        picture::write(path, camera, &learned)?;
    }
    let mut out = std::io::stdout().lock();
    let lines = report(camera, &learned);
    if !args.json {
        writeln!(out, "{}", lines.join("\n")).map_err(Failure::other)?;
        if let Some(path) = &args.picture {
            writeln!(out, "picture: {}", path.display()).map_err(Failure::other)?;
        }
    }
    let is_better = learned.is_better(camera);
    if is_better {
        let mut remarks = vec![
            "Written by `oapwatch calibrate` from frames of unknown positions; name it in [optics] calibration."
                .to_owned(),
        ];
        remarks.extend(lines);
        file::write(&args.out, &file::render(&learned.calibration, &remarks)).map_err(Failure::other)?;
    }
    if args.json {
        writeln!(out, "{}", object(args, camera, &learned)).map_err(Failure::other)?;
    }
    if !is_better {
        return Err(Failure::Other(anyhow!(
            "{} was not written: on the held-out frames the spot of {} is as good as the learned one (χ² {:.0} and {:.0} of {} pixels), \
             and noise and pixels are as it says",
            args.out.display(),
            args.config.display(),
            learned.before.chi2,
            learned.after.chi2,
            learned.after.degrees_of_freedom
        )));
    }
    match args.json {
        true => Ok(()),
        false => writeln!(
            out,
            "written to {}; to use it, name it in [optics] calibration of {}",
            args.out.display(),
            args.config.display()
        )
        .map_err(Failure::other),
    }
}

/// All frames of the file or folder, J. A recording that is cut short ends there.
fn read(args: &Args, camera: &Camera) -> Result<Vec<Array2<f64>>, Failure> {
    let path = &args.frames;
    let files = record::frame_files(path)
        .with_context(|| path.display().to_string())
        .map_err(Failure::Input)?;
    if files.is_empty() {
        return Err(Failure::Input(anyhow!(
            "{}: no recordings in this folder",
            path.display()
        )));
    }
    let mut frames = Vec::new();
    for file in &files {
        let reader = npy::Reader::open(file, camera.joules_per_count).map_err(Failure::input)?;
        let (ny, nx) = reader.shape();
        if (ny, nx) != camera.shape() {
            return Err(Failure::Input(anyhow!(
                "{}: frames are {nx} × {ny} pixels, {} says {} × {}",
                file.display(),
                args.config.display(),
                camera.x.n,
                camera.y.n
            )));
        }
        for pixels in reader {
            match pixels {
                Ok(pixels) => frames.push(pixels),
                // A recorder that still runs leaves its newest file unfinished.
                Err(npy::Error::Truncated { .. }) if path.is_dir() => break,
                Err(e) => return Err(Failure::input(e)),
            }
        }
    }
    Ok(frames)
}

/// Obscuration below which none is told of: its square, the light that it takes, is then below what spots show.
const LEAST_OBSCURATION: f64 = 0.05;
/// Reduced χ² of held-out frames that raises no doubt: overlapping spots and bright ones add to it, nothing honest lowers it by as much.
const AS_EXPECTED: std::ops::Range<f64> = 0.8..1.5;

fn report(camera: &Camera, l: &Learned) -> Vec<String> {
    let mut lines = vec![format!(
        "{} frames, {} spots with a median peak of {:.0} σ and a largest of {:.0} σ, on {} of {} pixel phases and {} of 9 parts of the \
         sensor; {} held-out spots left out as odd",
        l.frames,
        l.spots,
        l.peak_snr[0],
        l.peak_snr[1],
        l.coverage.phases,
        spot::CELLS,
        l.coverage.field,
        l.odd
    )];
    lines.extend(shape(camera, l));
    lines.extend(pixels(camera, l));
    lines
}

/// What was learned of the spot's shape.
pub fn shape(camera: &Camera, l: &Learned) -> Vec<String> {
    let shape = &l.shape;
    let sigma = shape.sigma_equivalent_m();
    let pitch = camera.x.pitch_m;
    let field = match l.field_degree {
        0 if l.coverage.is_field_covered() => "the same all over the sensor".to_owned(),
        0 => "its change over the sensor is not known: the spots stand on too few parts of it".to_owned(),
        degree if l.coverage.is_field_covered() => format!("changing over the sensor (degree {degree})"),
        degree => format!("changing over the sensor (degree {degree}), by a guess where no spots stand"),
    };
    let mut lines = vec![format!(
        "spot: as wide as a Gaussian of {:.4} mm ({:.3} pixels; the config: {:.4} mm), {:.1} % of its light within 2 σ (a Gaussian: 86.5 %), {field}; {} separable terms. \
         Shares are of the light within {:.2} mm: what lies further out cannot be told from the background",
        1e3 * sigma,
        sigma / pitch,
        1e3 * camera.spot_sigma_m,
        100.0 * shape.encircled_energy([0.0; 2], 2.0 * sigma),
        shape.terms(),
        1e3 * shape.radius_m()
    )];
    if let Some(w) = &l.wavefront {
        let mut aperture = "a round aperture".to_owned();
        if w.obscuration > LEAST_OBSCURATION {
            aperture += &format!(", covered out to {:.2} of its radius", w.obscuration);
        }
        if let Some(rim) = w.rim {
            aperture += &format!(
                ", cut off by a rim of {:.2} of its radius that moves over {:.2} of it across half the sensor (vignetting)",
                rim.radius, rim.moves
            );
        }
        lines.push(format!(
            "wavefront: {aperture}; its first dark ring is at {:.4} mm; over the sensor {:.3} waves rms of defocus, {:.3} of \
             astigmatism, {:.3} of coma, {:.3} of trefoil, {:.3} of spherical aberration",
            1e3 * w.first_zero_m,
            w.defocus,
            w.astigmatism,
            w.coma,
            w.trefoil,
            w.spherical
        ));
    }
    lines.push(format!(
        "held-out frames: reduced χ² {:.4} with the spot so far, {:.4} with the learned one{}",
        l.before.reduced(),
        l.after.reduced(),
        match l.is_shape_better {
            true => "",
            false => ": the spot so far is as good and stays",
        }
    ));
    if !AS_EXPECTED.contains(&l.after.reduced()) {
        lines.push(
            "warning: the learned spot and noise do not explain the held-out frames as they should (reduced χ² 1); do dark levels, stray light or \
             the focus change while frames are taken, or is there a light that is no beam? Look at what `locate` finds with the calibration"
                .to_owned(),
        );
    }
    let error = l.calibration.spot_error.unwrap_or_default();
    let beyond = l
        .shape
        .beyond()
        .filter(|_| l.is_shape_better)
        .map_or_else(String::new, |beyond| {
            let (error, from_mm) = (beyond.error, 1e3 * beyond.from_m);
            format!("; {error:.2e} farther than {from_mm:.2} mm from its centre, where the shape is not known")
        });
    lines.push(format!(
        "spot error {error:.2e}: the share of a spot's light that the shape leaves unexplained{beyond}"
    ));
    lines
}

/// What was learned of the noise and of single pixels.
fn pixels(camera: &Camera, l: &Learned) -> Vec<String> {
    let gain = l.quantum_j.map_or_else(String::new, |g| {
        let counts = camera
            .joules_per_count
            .map_or_else(String::new, |c| format!(" ({:.4} counts)", g / c));
        format!("; the variance grows by {g:.3e} J per joule{counts}")
    });
    let mut lines = vec![format!(
        "noise {:.4e} J a pixel (the config: {:.4e} J){gain}",
        l.noise_std_j, camera.noise_std_j
    )];
    let gains = l.gain_scatter.map_or_else(
        || "no difference between gains shows".to_owned(),
        |scatter| format!("gain scatter {:.3} % rms", 100.0 * scatter),
    );
    lines.push(format!(
        "{gains}; bad pixels: {}; single bright pixels left out: {}",
        l.bad_pixels, l.flashes
    ));
    if l.saturated_frames > 0 {
        let level = l.saturation_j.unwrap_or(f64::INFINITY);
        lines.push(format!(
            "{} frames hold pixels saturated at {level:.3e} J; spots around them were left out",
            l.saturated_frames
        ));
    }
    if l.cut_off_frames > 0 {
        lines.push(format!(
            "warning: {} frames are cut off at their darkest value, and half of the noise with it: noise and stated errors are too small. Raise the \
             camera's black level until no pixel reaches 0, and record again",
            l.cut_off_frames
        ));
    }
    lines
}

fn object(args: &Args, camera: &Camera, l: &Learned) -> serde_json::Value {
    let written = l.is_better(camera).then(|| args.out.display().to_string());
    serde_json::json!({
        "written": written,
        "frames": l.frames,
        "spots": l.spots,
        "odd_spots": l.odd,
        "peak_snr": { "median": l.peak_snr[0], "largest": l.peak_snr[1] },
        "coverage": l.coverage,
        "spot": shape_object(camera, l),
        "spot_error": l.calibration.spot_error,
        "noise_std_j": l.noise_std_j,
        "gain_j": l.quantum_j,
        "gain_scatter": l.gain_scatter,
        "bad_pixels": l.bad_pixels,
        "flashes": l.flashes,
        "saturated_frames": l.saturated_frames,
        "cut_off_frames": l.cut_off_frames,
        "before": { "chi2": l.before.chi2, "degrees_of_freedom": l.before.degrees_of_freedom },
        "after": { "chi2": l.after.chi2, "degrees_of_freedom": l.after.degrees_of_freedom },
    })
}

/// The learned shape as JSON.
pub fn shape_object(camera: &Camera, l: &Learned) -> serde_json::Value {
    let radii: Vec<f64> = (1..=20).map(|k| 0.5 * f64::from(k) * camera.spot_sigma_m).collect();
    serde_json::json!({
        "is_better": l.is_shape_better,
        "terms": l.shape.terms(),
        "field_degree": l.field_degree,
        "wavefront": l.wavefront,
        "sigma_equivalent_m": l.shape.sigma_equivalent_m(),
        "reach_m": l.shape.radius_m(),
        "beyond": l.shape.beyond(),
        "encircled_energy": radii.iter().map(|r| [*r, l.shape.encircled_energy([0.0; 2], *r)]).collect::<Vec<_>>(),
    })
}
