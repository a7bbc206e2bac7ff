//! `oapwatch locate`: finds the emitters of every frame of a recording.

use std::io::Write;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, anyhow};
use jiff::Timestamp;
use serde::Serialize;

use super::recorded::{Recorded, Shot};
use super::{Failure, Outcome, progress};
use crate::config::Config;
use crate::estimate::{self, Emitter, Flags, Velocity};
use crate::frame::Frame;
use crate::geo::{Geodetic, LocalAxes, View};
use crate::optics::Smear;
use crate::platform::{Placement, Platform};
use crate::pose::Pose;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch locate --config oapwatch.toml frames.npy > emitters.ndjson\n  ssh camera cat frames.npy | oapwatch locate --config oapwatch.toml -"
)]
pub struct Args {
    /// Config with the optics of the frames
    #[arg(long)]
    config: PathBuf,
    /// Estimator to use instead of the configured one; `oapwatch tradeoff` compares them
    #[arg(long)]
    estimator: Option<String>,
    /// FRAMES.npy, - for stdin, or a recording that the daemon made (a file of it or the folder), with its own times and poses
    frames: PathBuf,
}

/// Why a frame has no positions although its emitters may be seen.
const NO_POSE: &str = "no pose of the platform is known at this time from which the camera sees ground: expected [platform] poses, or a recording that holds them";

/// One line of the output.
#[derive(Serialize)]
struct Line {
    frame: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    emitters: Option<Vec<Located>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    latency_us: u64,
    /// Weighted squared residual per degree of freedom.
    #[serde(skip_serializing_if = "Option::is_none")]
    reduced_chi2: Option<f64>,
    /// Share of a spot's light by which the spots were taken to differ from the model.
    #[serde(skip_serializing_if = "Option::is_none")]
    spot_error: Option<f64>,
    /// The search ended early: emitters may be missing, all of them too.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    is_cut_short: bool,
}

/// An emitter in the world.
#[derive(Serialize)]
struct Located {
    x_m: f64,
    y_m: f64,
    /// Height of the ground there.
    z_m: f64,
    /// The same on the earth, where the world has an origin.
    #[serde(flatten)]
    geodetic: Option<Geodetic>,
    cov_m2: [[f64; 2]; 2],
    energy_j: f64,
    #[serde(flatten)]
    velocity: Option<Velocity>,
    flags: Flags,
}

/// Where the emitters of a frame are.
struct Locator {
    platform: Platform,
    view: View,
    axes: Option<LocalAxes>,
}

impl Locator {
    /// Where the camera was at a frame's time, by the poses that came with the frame or are on file.
    fn placement(&mut self, poses: Vec<Pose>, time: Timestamp) -> Placement {
        self.platform.receive(poses, time, &self.view.camera);
        self.platform.at(time, &self.view.camera)
    }

    fn smear(&self, placement: &Placement, frame: &Frame) -> Option<Smear> {
        let camera = &self.view.camera;
        self.platform.smear(placement, camera, frame.time, frame.exposure_s?)
    }

    /// Moves emitters from where a level camera would see them to where this one does, with its pose's uncertainty. One whose ray
    /// does not come down to the ground has no position and is left out. `None` while no pose is known.
    fn locate(&mut self, emitters: &[Emitter], energy_scale: f64, placement: Placement) -> Option<Vec<Located>> {
        self.view.sight = match placement {
            Placement::Level => None,
            Placement::At { sight, .. } => Some(sight),
            Placement::Unknown { .. } => return None,
        };
        Some(emitters.iter().filter_map(|e| self.place(e, energy_scale)).collect())
    }

    fn place(&self, e: &Emitter, energy_scale: f64) -> Option<Located> {
        let placed = self.view.place(e.sensor_m, [e.x_m, e.y_m], e.cov_m2)?;
        let [x_m, y_m] = placed.position_m.into();
        let mut cov_m2 = placed.cov_m2;
        if self.view.sight.is_some() {
            let pose = self.view.pose_cov(placed.position_m);
            let off = cov_m2[0][1] + pose[(0, 1)];
            cov_m2 = [[cov_m2[0][0] + pose[(0, 0)], off], [off, cov_m2[1][1] + pose[(1, 1)]]];
        }
        Some(Located {
            x_m,
            y_m,
            z_m: placed.z_m,
            geodetic: self.axes.map(|axes| axes.to_geodetic([x_m, y_m, placed.z_m])),
            cov_m2,
            energy_j: e.energy_j * energy_scale,
            velocity: e.velocity,
            flags: e.flags,
        })
    }
}

pub fn run(args: Args) -> Outcome {
    let mut config = Config::load(&args.config).map_err(Failure::config)?;
    if args.estimator.is_some() {
        config.estimator.name = args.estimator;
    }
    let in_config = || args.config.display().to_string();
    let camera = config
        .optics
        .camera()
        .with_context(in_config)
        .map_err(Failure::Config)?;
    let mut estimator = estimate::build(&config.estimator, &camera)
        .with_context(in_config)
        .map_err(Failure::Config)?;
    let recorded = Recorded::open(&args.frames, &config, &camera)?;
    let budget = config.estimator.budget();
    let platform = Platform::open(&config.platform, &config.world, camera.altitude_m);
    let platform = platform.map_err(Failure::config)?;
    for warning in platform.warnings() {
        eprintln!("oapwatch: {}: warning: {warning}", args.config.display());
    }
    let mut locator = Locator {
        platform,
        view: View::level(&camera),
        axes: config.world.axes(),
    };
    let path = recorded.path().to_owned();
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    let bar = progress::count("frames");
    let (mut usable, mut misshapen, mut cut_short, mut first_error) = (0_u64, 0_u64, 0_u64, None);
    for shot in recorded {
        let Shot {
            index,
            time,
            frame,
            poses,
        } = match shot {
            Ok(shot) => shot,
            Err(e) => {
                out.flush().map_err(Failure::other)?;
                return Err(Failure::input(e));
            }
        };
        let clock = Instant::now();
        let is_over = || budget.is_some_and(|budget| clock.elapsed() >= budget);
        let placement = locator.placement(poses, time);
        let energy_scale = frame.as_ref().map_or(1.0, |frame| frame.energy_scale);
        let estimate = frame.and_then(|frame| {
            estimator.set_smear(locator.smear(&placement, &frame).as_ref());
            estimator.set_sight(locator.platform.passing_sight(&placement));
            estimator.estimate_until(&frame, &is_over).map_err(|e| e.to_string())
        });
        let located = match &estimate {
            Ok(estimate) => locator
                .locate(&estimate.emitters, energy_scale, placement)
                .ok_or_else(|| NO_POSE.to_owned()),
            Err(e) => Err(e.clone()),
        };
        let latency_us = clock.elapsed().as_micros() as u64;
        let (emitters, error) = match located {
            Ok(emitters) => {
                usable += 1;
                (Some(emitters), None)
            }
            Err(e) => {
                first_error.get_or_insert_with(|| e.clone());
                (None, Some(e))
            }
        };
        let line = Line {
            frame: index,
            emitters,
            error,
            latency_us,
            reduced_chi2: estimate.as_ref().ok().map(|e| e.reduced_chi2),
            spot_error: estimate.as_ref().ok().map(|e| e.spot_error).filter(|e| *e > 0.0),
            is_cut_short: estimate.as_ref().is_ok_and(|e| e.is_cut_short),
        };
        cut_short += u64::from(line.is_cut_short);
        misshapen += u64::from(line.spot_error.is_some_and(|share| share > camera.spot_error.least()));
        serde_json::to_writer(&mut out, &line).map_err(|e| Failure::other(std::io::Error::from(e)))?;
        writeln!(out).map_err(Failure::other)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    out.flush().map_err(Failure::other)?;
    if cut_short > 0 {
        eprintln!(
            "{cut_short} of {usable} frames: the search ended early, emitters may be missing ([estimator] budget_ms, or more light than can be searched)"
        );
    }
    if 2 * misshapen > usable {
        eprintln!(
            "{misshapen} of {usable} frames: the spot is not what the config says (positions may be less precise, faint emitters \
             beside bright ones are not seen); run `oapwatch calibrate --config {} --out CALIBRATION.toml {}`",
            args.config.display(),
            path.display()
        );
    }
    match (usable, first_error) {
        (0, Some(error)) => Err(Failure::Input(anyhow!(
            "{}: no frame can be used; the first: {error}",
            path.display()
        ))),
        _ => Ok(()),
    }
}
