//! `oapwatch man`: writes the manual pages.

use std::path::PathBuf;

use clap::CommandFactory;

use super::{Failure, Outcome};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for oapwatch.1 and one page a command
    out: PathBuf,
}

pub fn run(args: Args) -> Outcome {
    std::fs::create_dir_all(&args.out).map_err(Failure::other)?;
    clap_mangen::generate_to(super::Cli::command(), &args.out).map_err(Failure::other)
}
