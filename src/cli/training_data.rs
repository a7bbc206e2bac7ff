//! `oapwatch training-data`: streams simulated frames with their truth.

use std::io::{BufWriter, IsTerminal};
use std::path::PathBuf;

use super::{Failure, Outcome};
use crate::scene::{Plan, Scene};
use crate::study::samples;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch training-data --scene config/scenes/paper.toml --samples 1000 > samples.bin"
)]
pub struct Args {
    /// A scene file
    #[arg(long)]
    scene: PathBuf,
    /// How many samples
    #[arg(long)]
    samples: u64,
    /// Number of the first sample, to continue a stream
    #[arg(long, default_value_t = 0)]
    first: u64,
    /// The same seed gives the same samples
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

pub fn run(args: Args) -> Outcome {
    let scene = Scene::load(&args.scene).map_err(Failure::config)?;
    let plan = Plan::compile(&scene, args.seed).map_err(Failure::config)?;
    let stdout = std::io::stdout();
    if stdout.is_terminal() {
        return Err(Failure::input(anyhow::anyhow!(
            "stdout is a terminal, and the samples are binary: pipe them into a trainer"
        )));
    }
    let name = args.scene.file_stem().unwrap_or_default().to_string_lossy();
    match samples::write(
        &plan,
        &name,
        args.first,
        args.samples,
        &mut BufWriter::new(stdout.lock()),
    ) {
        Ok(()) => Ok(()),
        Err(samples::Error::Io(e)) => Err(Failure::other(e)),
        Err(e) => Err(Failure::input(e)),
    }
}
