use super::Outcome;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long)]
    config: Option<std::path::PathBuf>,
    /// Address for the API instead of the one configured
    #[arg(long)]
    listen: Option<std::net::SocketAddr>,
}

pub fn run(_args: Args) -> Outcome {
    Err(super::Failure::other(anyhow::anyhow!("run is not built yet")))
}
