//! `oapwatch stability`: runs the catalogue of hard cases.

use std::io::Write;
use std::path::PathBuf;

use super::progress::Steps;
use super::{Failure, Outcome};
use crate::estimate::{self, Rules};
use crate::study::stability::{Options, catalogue, markdown};

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  oapwatch stability --only NaN\n  oapwatch stability --without reweighting")]
pub struct Args {
    /// Frames of each kind
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    /// The same seed gives the same frames
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Estimator to test; the default one when left out
    #[arg(long, value_name = "NAME")]
    estimator: Option<String>,
    /// Leave out this rule of `ml` and `map`: which cases need it
    #[arg(long, value_name = "RULE", value_parser = clap::builder::PossibleValuesParser::new(Rules::NAMES))]
    without: Option<String>,
    /// Only cases whose group or name contains this
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Write the tables to this file as Markdown as well
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub fn run(args: Args) -> Outcome {
    let options = Options {
        frames: args.frames as usize,
        seed: args.seed,
        estimator: estimate::Config {
            name: args.estimator,
            rules: args.without.as_deref().and_then(Rules::without).unwrap_or_default(),
            ..estimate::Config::default()
        },
    };
    if let Some(name) = &options.estimator.name {
        estimate::find(name).map_err(Failure::input)?;
    }
    let wanted = |text: &str| args.only.as_ref().is_none_or(|only| text.contains(only.as_str()));
    let mut rows = Vec::new();
    let mut cases = catalogue();
    cases.retain(|case| wanted(case.group) || wanted(&case.name));
    let mut steps = Steps::new(cases.len() as u64);
    for case in cases {
        rows.push(case.run(&options));
        steps.next(&case.name);
    }
    steps.finish();
    let text = markdown(&rows, &options);
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}").map_err(Failure::other)?;
    if let Some(path) = &args.out {
        std::fs::write(path, &text).map_err(|e| Failure::other(anyhow::anyhow!("{}: {e}", path.display())))?;
    }
    let broken = rows.iter().filter(|r| !r.seen.holds).count();
    if broken > 0 {
        return Err(Failure::other(anyhow::anyhow!(
            "{broken} of {} requirements do not hold",
            rows.len()
        )));
    }
    writeln!(out, "All {} requirements hold.", rows.len()).map_err(Failure::other)
}
