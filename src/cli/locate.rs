use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    config: std::path::PathBuf,
    /// A rung of the ladder instead of the one configured
    #[arg(long)]
    estimator: Option<String>,
    /// FRAMES.npy
    frames: std::path::PathBuf,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("locate is not built yet")))
}
