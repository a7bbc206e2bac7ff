use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    out: Option<std::path::PathBuf>,
    /// Under a minute, fewer frames
    #[arg(long)]
    quick: bool,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("tradeoff is not built yet")))
}
