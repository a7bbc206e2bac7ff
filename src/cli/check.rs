use std::path::PathBuf;

use super::{Failure, Outcome};
use crate::config::Config;

#[derive(Debug, clap::Args)]
pub struct Args {
    /// A config or scene
    file: PathBuf,
}

pub fn run(args: Args) -> Outcome {
    let config = Config::load(&args.file).map_err(Failure::config)?;
    let camera = config.optics.camera().map_err(Failure::config)?;
    println!(
        "{}: a config; {} × {} pixels, source {}",
        args.file.display(),
        camera.x.n,
        camera.y.n,
        config.source.kind.name()
    );
    Ok(())
}
