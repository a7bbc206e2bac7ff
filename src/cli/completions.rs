//! `oapwatch completions`: prints shell completions.

use std::io::Write;

use clap::CommandFactory;

use super::{Failure, Outcome};

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  oapwatch completions bash > /usr/share/bash-completion/completions/oapwatch")]
pub struct Args {
    shell: clap_complete::Shell,
}

pub fn run(args: Args) -> Outcome {
    // Into memory first: the generator panics when its output is closed.
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut super::Cli::command(), "oapwatch", &mut script);
    std::io::stdout().write_all(&script).map_err(Failure::other)
}
