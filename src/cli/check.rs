//! `oapwatch check`: validates a config or scene.

use std::path::PathBuf;

use super::{Failure, Outcome};
use crate::config::Config;
use crate::pipeline::Pipeline;
use crate::scene::{Plan, Scene};
use crate::{api, frames, notify, toml_file};

/// Keys of a scene that no config has.
const OF_SCENES: [&str; 7] = [
    "about",
    "rate_hz",
    "link",
    "random_emitters",
    "user",
    "intruder",
    "effects",
];

#[derive(Debug, clap::Args)]
pub struct Args {
    /// A config or scene
    file: PathBuf,
}

pub fn run(args: Args) -> Outcome {
    let name = args.file.display();
    let table: toml::Table = toml_file::read(&args.file).map_err(Failure::config)?;
    if OF_SCENES.iter().any(|key| table.contains_key(*key)) {
        let scene = Scene::load(&args.file).map_err(Failure::config)?;
        Plan::compile(&scene, 0).map_err(Failure::config)?;
        println!(
            "{name}: a scene, {} users and {} intruders",
            scene.user.len(),
            scene.intruder.len()
        );
        return Ok(());
    }
    let config = Config::load(&args.file).map_err(Failure::config)?;
    let camera = config.camera().map_err(Failure::config)?;
    let pipeline = Pipeline::new(&config, &camera).map_err(Failure::config)?;
    frames::open(&config.source, &camera).map_err(Failure::config)?;
    config.log.filter().map_err(Failure::config)?;
    api::Server::new(config.api.clone()).map_err(Failure::config)?;
    notify::load(&config.webhook).map_err(Failure::config)?;
    println!(
        "{name}: a config; {} × {} pixels, source {}, estimator {}",
        camera.x.n,
        camera.y.n,
        config.source.kind.name(),
        pipeline.estimator()
    );
    Ok(())
}
