//! `oapwatch completions`: prints shell completions.

use clap::CommandFactory;

use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    shell: clap_complete::Shell,
}

pub fn run(args: Args) -> Outcome {
    clap_complete::generate(
        args.shell,
        &mut super::Cli::command(),
        "oapwatch",
        &mut std::io::stdout(),
    );
    Ok(())
}
