use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use super::{Failure, Outcome};
use crate::study::tradeoff::{Plan, run as study};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for tradeoff.md, tradeoff.json and the pictures; measurements already there are kept
    #[arg(long, default_value = "tradeoff")]
    out: PathBuf,
    /// Under a minute, fewer frames
    #[arg(long)]
    quick: bool,
    /// Frames a cell
    #[arg(long)]
    frames: Option<usize>,
    /// The same seed gives the same frames
    #[arg(long)]
    seed: Option<u64>,
}

pub fn run(args: Args) -> Outcome {
    let mut plan = if args.quick { Plan::quick() } else { Plan::full() };
    if let Some(frames) = args.frames {
        plan.frames = frames.max(1);
    }
    if let Some(seed) = args.seed {
        plan.seed = seed;
    }
    let style =
        ProgressStyle::with_template("{bar:40} {pos}/{len} {elapsed} (left {eta}) {msg}").map_err(Failure::other)?;
    let bar = ProgressBar::new(plan.len() as u64).with_style(style);
    study(&plan, &args.out, &mut |row| {
        bar.set_message(format!("{} {}", row.cell.name(), row.rung));
        bar.inc(1);
    })
    .map_err(Failure::other)?;
    bar.finish_and_clear();
    print!(
        "{}",
        std::fs::read_to_string(args.out.join("tradeoff.md")).map_err(Failure::other)?
    );
    eprintln!("written to {}", args.out.display());
    Ok(())
}
