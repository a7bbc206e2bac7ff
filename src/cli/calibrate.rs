use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    config: std::path::PathBuf,
    /// NDJSON with the known positions of each frame
    #[arg(long)]
    truth: std::path::PathBuf,
    /// Where to write the calibration
    #[arg(long)]
    out: std::path::PathBuf,
    /// FRAMES.npy
    frames: std::path::PathBuf,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("calibrate is not built yet")))
}
