//! `oapwatch study`: measures what needs many random stories.

use std::io::Write;

use super::progress::Steps;
use super::{Failure, Outcome};
use crate::estimate::{self, ESTIMATORS, Rules};
use crate::study::measurements::{ALL, Measurement};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch study honest intruder beyond drift\n  oapwatch study stranger --stories 12000 --seed 200000"
)]
pub struct Args {
    /// What to measure: the monitor alone (honest to zones; handover with a hub), the program on the simulator's pixels (honest-pixels to
    /// flights), or the optics and the estimator (calibration to crowds)
    #[arg(required = true, value_parser = clap::builder::PossibleValuesParser::new(ALL.iter().map(|m| m.name)))]
    what: Vec<String>,
    /// Stories of each, of 8 s to two minutes of frames (devices of the calibration, frames of a lens, a pixel format or a crowd, walks of a cell of `sequence`)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    stories: Option<u64>,
    /// Seed of the first story; the others follow
    #[arg(long, value_name = "S", default_value_t = 1000)]
    seed: u64,
    /// Of lens, lens-calibrated, lens-alerts, sensor-alerts: only the rows whose name begins so ("airy disc 300"); may be repeated
    #[arg(long, value_name = "ROW")]
    only: Vec<String>,
    /// Of honest-pixels to flights and the lens studies: the estimator
    #[arg(long, value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(ESTIMATORS.iter().map(|e| e.name)))]
    estimator: Option<String>,
    /// Of sequence, honest-pixels to flights and the lens studies: a rule of the estimator to leave out
    #[arg(long, value_name = "RULE", value_parser = clap::builder::PossibleValuesParser::new(Rules::NAMES.iter().chain(Rules::OF_SEQUENCES)))]
    without: Option<String>,
}

pub fn run(args: Args) -> Outcome {
    let is_wanted = |m: &&Measurement| args.what.iter().any(|name| name == m.name);
    let wanted: Vec<&Measurement> = ALL.iter().filter(is_wanted).collect();
    let estimator = estimate::Config {
        name: args.estimator,
        rules: args.without.and_then(|rule| Rules::without(&rule)).unwrap_or_default(),
        ..Default::default()
    };
    let mut steps = Steps::new(wanted.len() as u64);
    let mut broken = Vec::new();
    for measurement in wanted {
        let print = |text: &str| steps.suspend(|| writeln!(std::io::stdout(), "{text}"));
        let mut printed = print(&format!("## {}\n", measurement.name));
        let mut say = |line: &str| printed = std::mem::replace(&mut printed, Ok(())).and_then(|()| print(line));
        let stories = args.stories.unwrap_or(measurement.stories);
        let measured = measurement.run(stories, args.seed, &args.only, &estimator, &mut say);
        say(&measured.text);
        printed.map_err(Failure::other)?;
        steps.next(measurement.name);
        if !measured.holds {
            broken.push(measurement.name);
        }
    }
    steps.finish();
    match broken[..] {
        [] => Ok(()),
        _ => Err(Failure::other(anyhow::anyhow!(
            "requirements not met: {}",
            broken.join(", ")
        ))),
    }
}
