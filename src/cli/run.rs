//! `oapwatch run`: the daemon.

use std::path::PathBuf;

use super::{Failure, Outcome};
use crate::api::Listen;
use crate::config::Config;
use crate::daemon::Daemon;
use crate::logging;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch run\n  oapwatch run --config /etc/oapwatch/oapwatch.toml\n  oapwatch run --listen localhost:9000"
)]
pub struct Args {
    /// Config file; without one the daemon runs on the built-in simulator
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address for the API instead of the one configured: 127.0.0.1:8787, localhost:8787 or unix:PATH
    #[arg(long)]
    listen: Option<Listen>,
}

/// Most threads that serve the API, and most that wait for the journal on its behalf. Bounded because each costs memory and the
/// frames have threads of their own.
const MOST_SERVING: usize = 4;
const MOST_WAITING: usize = 32;

pub fn run(args: Args) -> Outcome {
    let mut config = match &args.config {
        Some(path) => Config::load(path).map_err(Failure::config)?,
        None => Config::default(),
    };
    if let Some(listen) = args.listen {
        config.api.listen = listen;
    }
    let logging = logging::install(&config.log).map_err(Failure::config)?;
    // Huge pages would raise the resident memory from a few megabytes to tens, growing with time.
    if let Err(refused) = rustix::thread::disable_transparent_huge_pages(true) {
        tracing::warn!(%refused, "transparent huge pages stay on: memory use will be higher");
    }
    let daemon = Daemon::new(config, args.config).map_err(Failure::Config)?;
    // One core is the compute thread's.
    runtime(1)?
        .block_on(daemon.run(logging.clone()))
        .map_err(Failure::Other)
}

/// Where a daemon's tasks run: on all cores but `taken`.
pub(super) fn runtime(taken: usize) -> Result<tokio::runtime::Runtime, Failure> {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .worker_threads(cores.saturating_sub(taken).clamp(1, MOST_SERVING))
        .max_blocking_threads(MOST_WAITING)
        .thread_name("oapwatch")
        .build()
        .map_err(Failure::other)
}
