//! `oapwatch locate`: finds the emitters of every frame of a recording.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, anyhow};
use serde::Serialize;

use super::{Failure, Outcome, progress};
use crate::config::Config;
use crate::estimate::{self, Emitter};
use crate::frame::Frame;
use crate::frames::npy;

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
    /// FRAMES.npy, or - for stdin
    frames: PathBuf,
}

/// One line of the output.
#[derive(Serialize)]
struct Line<'a> {
    frame: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    emitters: Option<&'a [Emitter]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    latency_us: u64,
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
    let path = match args.frames == Path::new("-") {
        true => Path::new("/dev/stdin"),
        false => &args.frames,
    };
    let frames = npy::Reader::open(path, camera.joules_per_count).map_err(Failure::input)?;
    let budget = config.estimator.budget();
    let start = config.source.start.unwrap_or(jiff::Timestamp::UNIX_EPOCH);
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    let bar = progress::count("frames");
    let (mut usable, mut first_error) = (0_u64, None);
    for (index, pixels) in frames.enumerate() {
        let pixels = match pixels {
            Ok(pixels) => pixels,
            Err(e) => {
                out.flush().map_err(Failure::other)?;
                return Err(Failure::input(e));
            }
        };
        let frame = Frame {
            index: index as u64,
            time: start,
            pixels,
            masked: None,
        };
        let clock = Instant::now();
        let is_over = || budget.is_some_and(|budget| clock.elapsed() >= budget);
        let estimate = estimator.estimate_until(&frame, &is_over);
        let latency_us = clock.elapsed().as_micros() as u64;
        let (emitters, error) = match &estimate {
            Ok(estimate) => {
                usable += 1;
                (Some(estimate.emitters.as_slice()), None)
            }
            Err(e) => {
                first_error.get_or_insert_with(|| e.to_string());
                (None, Some(e.to_string()))
            }
        };
        let line = Line {
            frame: frame.index,
            emitters,
            error,
            latency_us,
        };
        serde_json::to_writer(&mut out, &line).map_err(|e| Failure::other(std::io::Error::from(e)))?;
        writeln!(out).map_err(Failure::other)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    out.flush().map_err(Failure::other)?;
    match (usable, first_error) {
        (0, Some(error)) => Err(Failure::Input(anyhow!(
            "{}: no frame can be used; the first: {error}",
            path.display()
        ))),
        _ => Ok(()),
    }
}
