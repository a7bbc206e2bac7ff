//! `oapwatch tradeoff`: measures accuracy against time.

use std::io::Write;
use std::path::PathBuf;

use super::progress::Steps;
use super::{Failure, Outcome};
use crate::estimate::Rules;
use crate::study::ablation;
use crate::study::tradeoff::{Cell, EXPOSURE_CELLS, Oracle, Plan, Trained, run as study, run_exposures};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch tradeoff --quick --out out\n  oapwatch tradeoff --cells P8/60,E1/64 --estimators ml,map --frames 1000 --out out\n  oapwatch tradeoff --without all --frames 40\n  oapwatch tradeoff --oracle --quick\n  oapwatch tradeoff --exposure --out out"
)]
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
    #[arg(long, alias = "rungs", value_name = "NAME", value_delimiter = ',')]
    estimators: Vec<String>,
    /// What each of these rules gains and costs, measured with and without it; `all` takes each in turn
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    without: Vec<String>,
    /// Folder of trained networks with their cards: `network` and `hybrid` are measured with each where it was trained
    #[arg(long)]
    networks: Option<PathBuf>,
    /// The same seed gives the same frames
    #[arg(long)]
    seed: Option<u64>,
    /// Print instead how far `map` is from the most probable hypothesis: its search against one that starts from the truth
    #[arg(long, conflicts_with_all = ["estimators", "networks"])]
    oracle: bool,
    /// Measure instead accuracy against observation time: one long exposure against many short ones of the same light (exposure.md,
    /// exposure.svg)
    #[arg(long, conflicts_with_all = ["oracle", "without", "estimators", "networks", "cells"])]
    exposure: bool,
}

/// Scenes of `--exposure`, unless given by `--frames`.
const EXPOSURE_SCENES: usize = 20;
const EXPOSURE_QUICK_SCENES: usize = 2;
const EXPOSURE_SEED: u64 = 1;

/// Frames per cell and seed of `--oracle`, unless given.
const ORACLE_FRAMES: usize = 1000;
const ORACLE_QUICK_FRAMES: usize = 20;
const ORACLE_SEED: u64 = 2;

pub fn run(args: Args) -> Outcome {
    if args.oracle {
        return oracle(&args);
    }
    if args.exposure {
        return exposures(&args);
    }
    let mut plan = match (args.quick, args.without.is_empty()) {
        (true, _) => Plan::quick(),
        (false, true) => Plan::full(),
        (false, false) => Plan::ablation(),
    };
    if let Some(frames) = args.frames {
        plan.frames = frames.max(1);
    }
    if let Some(seed) = args.seed {
        plan.seed = seed;
    }
    plan.cells = only("--cells", &args.cells, plan.cells, Cell::name)?;
    plan.estimators = only("--estimators", &args.estimators, plan.estimators, |e| e.to_string())?;
    if let Some(folder) = &args.networks {
        plan.networks = Trained::in_folder(folder).map_err(Failure::input)?;
    }
    if plan.is_empty() {
        return Err(Failure::input(anyhow::anyhow!(
            "nothing to measure: expected a network that was trained for the cell (--networks), found none"
        )));
    }
    if !args.without.is_empty() {
        return ablate(&plan, &args);
    }
    let mut steps = Steps::new(plan.len() as u64);
    study(&plan, &args.out, &mut |row| {
        steps.next(&format!("{} {}", row.cell.name(), row.estimator));
    })
    .map_err(Failure::other)?;
    steps.finish();
    let table = std::fs::read_to_string(args.out.join("tradeoff.md")).map_err(Failure::other)?;
    std::io::stdout().write_all(table.as_bytes()).map_err(Failure::other)?;
    eprintln!("written to {}", args.out.display());
    Ok(())
}

/// Those of `all` that are named, all of them where none is.
fn only<T>(option: &str, named: &[String], all: Vec<T>, name: impl Fn(&T) -> String) -> Result<Vec<T>, Failure> {
    let names: Vec<String> = all.iter().map(name).collect();
    if let Some(unknown) = named.iter().find(|n| !names.contains(n)) {
        return Err(Failure::input(anyhow::anyhow!(
            "{option}: expected some of {}, found {unknown}",
            names.join(", ")
        )));
    }
    let kept = all
        .into_iter()
        .zip(&names)
        .filter(|(_, n)| named.is_empty() || named.contains(n));
    Ok(kept.map(|(one, _)| one).collect())
}

fn exposures(args: &Args) -> Outcome {
    let usual = match args.quick {
        true => EXPOSURE_QUICK_SCENES,
        false => EXPOSURE_SCENES,
    };
    let scenes = args.frames.map_or(usual, |n| n.max(1));
    let mut steps = Steps::new(EXPOSURE_CELLS as u64);
    let table = run_exposures(scenes, args.seed.unwrap_or(EXPOSURE_SEED), &args.out, &mut |cell| {
        steps.next(&cell.name());
    })
    .map_err(Failure::other)?;
    steps.finish();
    std::io::stdout().write_all(table.as_bytes()).map_err(Failure::other)?;
    eprintln!("written to {}", args.out.display());
    Ok(())
}

/// Prints one row per cell as soon as it is measured.
fn oracle(args: &Args) -> Outcome {
    let cells = only("--cells", &args.cells, Oracle::cells(), Cell::name)?;
    let frames = args
        .frames
        .map_or(if args.quick { ORACLE_QUICK_FRAMES } else { ORACLE_FRAMES }, |n| {
            n.max(1)
        });
    let mut steps = Steps::new(cells.len() as u64);
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", Oracle::HEAD).map_err(Failure::other)?;
    for cell in cells {
        let row = Oracle::measure(cell, frames, args.seed.unwrap_or(ORACLE_SEED)).map_err(Failure::other)?;
        steps.suspend(|| writeln!(out, "{row}")).map_err(Failure::other)?;
        steps.next(&cell.name());
    }
    steps.finish();
    Ok(())
}

/// Estimators with rules to leave out.
const RULED: [&str; 6] = ["peak-fit", "greedy-fit", "pencil", "pencil-fit", "ml", "map"];

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
        estimators: plan
            .estimators
            .iter()
            .copied()
            .filter(|name| RULED.contains(name))
            .collect(),
        without,
        frames: plan.frames,
        seed: plan.seed,
    };
    let mut steps = Steps::new(plan.cells.len() as u64);
    let effects = ablation::run(&plan, &mut |cell| steps.next(&cell.name())).map_err(Failure::other)?;
    steps.finish();
    let table = ablation::markdown(&effects, &plan);
    std::io::stdout().write_all(table.as_bytes()).map_err(Failure::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_select_and_unknown_ones_are_named() {
        let all = || vec!["E1/64", "P8/60"];
        let select = |named: &[&str]| {
            let named: Vec<String> = named.iter().map(ToString::to_string).collect();
            only("--cells", &named, all(), ToString::to_string)
        };
        assert_eq!(select(&[]).unwrap(), all());
        assert_eq!(select(&["P8/60"]).unwrap(), ["P8/60"]);
        let Err(Failure::Input(error)) = select(&["P8/60", "P8/61"]) else {
            panic!("a name that there is none of was taken");
        };
        let expected = "--cells: expected some of E1/64, P8/60, found P8/61";
        assert_eq!(error.to_string(), expected);
    }
}
