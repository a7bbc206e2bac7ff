use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    scene: std::path::PathBuf,
    #[arg(long)]
    frames: u64,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[arg(long)]
    out: std::path::PathBuf,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("simulate is not built yet")))
}
