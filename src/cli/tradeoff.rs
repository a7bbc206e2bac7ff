//! `oapwatch tradeoff`: measures accuracy against time.

use std::io::Write;
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use super::{Failure, Outcome, progress};
use crate::estimate::Rules;
use crate::study::ablation;
use crate::study::tradeoff::{Oracle, Plan, Trained, run as study};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for tradeoff.md, tradeoff.json and the pictures; measurements already there are kept
    #[arg(long, default_value = "tradeoff")]
    out: PathBuf,
    /// Under a minute, fewer frames
    #[arg(long)]
    quick: bool,
    /// Frames per cell
    #[arg(long)]
    frames: Option<usize>,
    /// Only these cells, as "P8/60,E1/64"
    #[arg(long, value_delimiter = ',')]
    cells: Vec<String>,
    /// Only these estimators, as "pencil,ml"
    #[arg(long, value_delimiter = ',')]
    rungs: Vec<String>,
    /// What each of these rules of `ml` and `map` gains and costs, measured with and without it; `all` takes each in turn
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    without: Vec<String>,
    /// Folder of trained networks with their cards: `network` and `hybrid` are measured with each where it was trained
    #[arg(long)]
    networks: Option<PathBuf>,
    /// The same seed gives the same frames
    #[arg(long)]
    seed: Option<u64>,
    /// Print instead how far `map` is from the most probable hypothesis: its search against one that starts from the truth
    #[arg(long, conflicts_with_all = ["rungs", "networks"])]
    oracle: bool,
}

/// Frames per cell and seed of `--oracle`, unless given.
const ORACLE_FRAMES: usize = 1000;
const ORACLE_QUICK_FRAMES: usize = 20;
const ORACLE_SEED: u64 = 2;

pub fn run(args: Args) -> Outcome {
    if args.oracle {
        return oracle(&args);
    }
    let mut plan = if args.quick { Plan::quick() } else { Plan::full() };
    if let Some(frames) = args.frames {
        plan.frames = frames.max(1);
    }
    if let Some(seed) = args.seed {
        plan.seed = seed;
    }
    if !args.cells.is_empty() {
        plan.cells.retain(|c| args.cells.contains(&c.name()));
    }
    if !args.rungs.is_empty() {
        plan.rungs.retain(|r| args.rungs.iter().any(|name| name == r));
    }
    if let Some(folder) = &args.networks {
        plan.networks = Trained::in_folder(folder).map_err(Failure::input)?;
    }
    if plan.is_empty() {
        return Err(Failure::input(anyhow::anyhow!(
            "nothing to measure: no such cell or estimator; a run without --cells and --rungs names them all"
        )));
    }
    if !args.without.is_empty() {
        return ablate(&plan, &args);
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

/// Prints one row per cell as soon as it is measured.
fn oracle(args: &Args) -> Outcome {
    let mut cells = Oracle::cells();
    if !args.cells.is_empty() {
        cells.retain(|c| args.cells.contains(&c.name()));
    }
    if cells.is_empty() {
        let names: Vec<String> = Oracle::cells().iter().map(|c| c.name()).collect();
        return Err(Failure::input(anyhow::anyhow!(
            "--cells: expected some of {}, found {}",
            names.join(", "),
            args.cells.join(", ")
        )));
    }
    let frames = args
        .frames
        .map_or(if args.quick { ORACLE_QUICK_FRAMES } else { ORACLE_FRAMES }, |n| {
            n.max(1)
        });
    let bar = progress::bar(cells.len() as u64, "cells");
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", Oracle::HEAD).map_err(Failure::other)?;
    for cell in cells {
        let row = Oracle::measure(cell, frames, args.seed.unwrap_or(ORACLE_SEED)).map_err(Failure::other)?;
        bar.suspend(|| writeln!(out, "{row}")).map_err(Failure::other)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

/// Estimators with rules to leave out.
const RULED: [&str; 2] = ["ml", "map"];

fn ablate(plan: &Plan, args: &Args) -> Outcome {
    let is_wanted = |rule: &&&str| args.without.iter().any(|name| name == "all" || name == **rule);
    let without: Vec<&'static str> = Rules::NAMES.iter().filter(is_wanted).copied().collect();
    let known = |name: &&String| *name == "all" || Rules::NAMES.contains(&name.as_str());
    if let Some(unknown) = args.without.iter().find(|name| !known(name)) {
        return Err(Failure::input(anyhow::anyhow!(
            "--without: expected all or one of {}, found {unknown:?}",
            Rules::NAMES.join(", ")
        )));
    }
    let plan = ablation::Plan {
        cells: plan.cells.clone(),
        estimators: plan.rungs.iter().copied().filter(|name| RULED.contains(name)).collect(),
        without,
        frames: plan.frames,
        seed: plan.seed,
    };
    let bar = progress::bar(plan.cells.len() as u64, "cells");
    let effects = ablation::run(&plan, &mut || bar.inc(1)).map_err(Failure::other)?;
    bar.finish_and_clear();
    print!("{}", ablation::markdown(&effects, &plan));
    Ok(())
}
