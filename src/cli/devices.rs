use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("devices is not built yet")))
}
