//! The command line: one file per command.

mod calibrate;
mod camera_source;
mod capture;
mod check;
mod claims;
mod completions;
mod devices;
mod explain;
mod failure;
mod fleet;
mod golden;
mod interrupt;
mod locate;
mod man;
mod nkey;
mod picture;
mod progress;
mod recorded;
mod review;
mod run;
mod setup;
mod simulate;
mod simulated_recording;
mod stability;
mod study;
mod tradeoff;
mod training_data;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

pub use failure::{Failure, Outcome};

/// Watches every beam that reaches a UAV-mounted optical access point.
#[derive(Debug, Parser)]
#[command(
    version,
    about,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad input, 64 bad config."
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the monitor: frames in, positions and alerts out, API and dashboard on 127.0.0.1:8787
    Run(run::Args),
    /// Run the hub of a fleet: alerts and positions of many access points, over NATS
    Fleet(fleet::Args),
    /// Make a key for an access point or a hub, and print what the NATS server is to know of it
    Nkey(nkey::Args),
    /// Find the emitters in a recording, one JSON object a frame on stdout
    Locate(locate::Args),
    /// Run the whole chain over a replay as fast as possible and print the alert events
    Review(review::Args),
    /// Make frames, truth and claims from a scene
    Simulate(simulate::Args),
    /// List the effects that a scene simulates, the reason and the cost of each
    Explain(explain::Args),
    /// Learn the device's calibration from its frames, with or without known positions
    Calibrate(calibrate::Args),
    /// Measure what accuracy costs in time
    Tradeoff(tradeoff::Args),
    /// Write or compare golden answers: results of every estimator and the monitor on the same frames
    Golden(golden::Args),
    /// Stream simulated frames with their truth to a network's trainer
    TrainingData(training_data::Args),
    /// Run a catalogue of hard cases and print which requirements hold
    Stability(stability::Args),
    /// Measure how often honest users raise an alert, and how soon an attack does
    #[command(hide = true)]
    Study(study::Args),
    /// Validate a config or scene without running it
    Check(check::Args),
    /// Print what is understood of a claims log, and why the rest is refused
    Claims(claims::Args),
    /// List V4L2 devices with their formats and sizes
    Devices(devices::Args),
    /// Look at a camera and write a config for it
    Setup(setup::Args),
    /// Write a camera's frames to a file, as the daemon would see them
    Capture(capture::Args),
    /// Print shell completions
    Completions(completions::Args),
    /// Write the manual pages
    Man(man::Args),
}

/// Parses the command line and runs it.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            let code = if e.use_stderr() { 2 } else { 0 };
            let _ = e.print();
            return ExitCode::from(code);
        }
    };
    let outcome = match cli.command {
        Command::Run(args) => run::run(args),
        Command::Fleet(args) => fleet::run(args),
        Command::Nkey(args) => nkey::run(args),
        Command::Locate(args) => locate::run(args),
        Command::Review(args) => review::run(args),
        Command::Simulate(args) => simulate::run(args),
        Command::Explain(args) => explain::run(args),
        Command::Calibrate(args) => calibrate::run(args),
        Command::Tradeoff(args) => tradeoff::run(args),
        Command::Golden(args) => golden::run(args),
        Command::TrainingData(args) => training_data::run(args),
        Command::Stability(args) => stability::run(args),
        Command::Study(args) => study::run(args),
        Command::Check(args) => check::run(args),
        Command::Claims(args) => claims::run(args),
        Command::Devices(args) => devices::run(args),
        Command::Setup(args) => setup::run(args),
        Command::Capture(args) => capture::run(args),
        Command::Completions(args) => completions::run(args),
        Command::Man(args) => man::run(args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}
