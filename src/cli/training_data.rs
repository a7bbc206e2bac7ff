//! `oapwatch training-data`: streams simulated frames with their truth.

use std::io::{BufWriter, IsTerminal};
use std::path::PathBuf;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{Failure, Outcome};
use crate::scene::{self, Plan, Scene};
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
    /// Devices that samples are spread over, each with gains and defects of its own
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MOST_DEVICES))]
    devices: u64,
    /// Relative standard deviation of the spot's width from device to device; the first has the scene's
    #[arg(long, default_value_t = 0.0)]
    width_std: f64,
}

/// Each keeps its tables of the spot in memory.
const MOST_DEVICES: u64 = 256;

pub fn run(args: Args) -> Outcome {
    let scene = Scene::load(&args.scene).map_err(Failure::config)?;
    let devices = devices(&scene, &args).map_err(Failure::config)?;
    let stdout = std::io::stdout();
    if stdout.is_terminal() {
        return Err(Failure::input(anyhow::anyhow!(
            "stdout is a terminal, and the samples are binary: pipe them into a trainer"
        )));
    }
    let name = args.scene.file_stem().unwrap_or_default().to_string_lossy();
    match samples::write(
        &devices,
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

/// One scene through each of the devices.
fn devices(scene: &Scene, args: &Args) -> Result<Vec<Plan>, scene::Error> {
    let mut random = ChaCha8Rng::seed_from_u64(args.seed);
    let mut device = |k: u64| {
        let z: f64 = StandardNormal.sample(&mut random);
        let scene = match args.width_std * z {
            change if k > 0 && change != 0.0 => scene.with_width(1.0 + change)?,
            _ => scene.clone(),
        };
        Plan::compile(&scene, args.seed.wrapping_add(k << 32))
    };
    (0..args.devices).map(&mut device).collect()
}
