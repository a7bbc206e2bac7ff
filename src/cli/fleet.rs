//! `oapwatch fleet`: the hub of many access points.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::{Failure, Outcome, run};
use crate::api::Listen;
use crate::config::Config;
use crate::hub::chain::Settings;
use crate::hub::{Hub, ReviewError, review};
use crate::logging;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch fleet --config hub.toml\n  oapwatch fleet --config hub.toml --review recordings\n\nA hub's config has [fleet] with url (and site, for one site only), and [api], [journal], [record], [[webhook]] and [log] as an access point's."
)]
pub struct Args {
    /// Config file
    #[arg(long)]
    config: PathBuf,
    /// Address for the API instead of the one configured
    #[arg(long)]
    listen: Option<Listen>,
    /// Do not run: print the alert events of what a hub has recorded, a file or a `[record]` folder, one JSON object each
    #[arg(long, value_name = "PATH", conflicts_with = "listen")]
    review: Option<PathBuf>,
}

pub fn run(args: Args) -> Outcome {
    let mut config = Config::load(&args.config).map_err(Failure::config)?;
    if let Some(path) = args.review {
        return print_review(&path, Settings::new(&config));
    }
    if let Some(listen) = args.listen {
        config.api.listen = listen;
    }
    let logging = logging::install(&config.log).map_err(Failure::config)?;
    let hub = Hub::new(config).map_err(Failure::Config)?;
    run::runtime(0)?
        .block_on(hub.run(logging.clone()))
        .map_err(Failure::Other)
}

/// The same recording gives the same bytes, and the events that the hub had.
fn print_review(path: &Path, settings: Settings) -> Outcome {
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    let reviewed = review(path, settings, |event| {
        serde_json::to_writer(&mut out, event)?;
        out.write_all(b"\n")
    });
    reviewed.map_err(|error| match error {
        ReviewError::Output(error) => Failure::other(error),
        error => Failure::input(error),
    })?;
    out.flush().map_err(Failure::other)
}
