//! `oapwatch fleet`: the hub of many access points.

use std::path::PathBuf;

use super::{Failure, Outcome, run};
use crate::api::Listen;
use crate::config::Config;
use crate::hub::Hub;
use crate::logging;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch fleet --config hub.toml\n\nA hub's config has [fleet] with url (and site, for one site only), and [api], [journal], [[webhook]] and [log] as an access point's."
)]
pub struct Args {
    /// Config file
    #[arg(long)]
    config: PathBuf,
    /// Address for the API instead of the one configured
    #[arg(long)]
    listen: Option<Listen>,
}

pub fn run(args: Args) -> Outcome {
    let mut config = Config::load(&args.config).map_err(Failure::config)?;
    if let Some(listen) = args.listen {
        config.api.listen = listen;
    }
    let logging = logging::install(&config.log).map_err(Failure::config)?;
    let hub = Hub::new(config).map_err(Failure::Config)?;
    run::runtime()?.block_on(hub.run(logging)).map_err(Failure::Other)
}
