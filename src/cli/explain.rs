use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    scene: std::path::PathBuf,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("explain is not built yet")))
}
