use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    config: std::path::PathBuf,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("review is not built yet")))
}
