//! `oapwatch check`: validates a config or scene.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::{Failure, Outcome};
use crate::config::Config;
use crate::notify::Endpoint;
use crate::pipeline::Pipeline;
use crate::scene::{Plan, Scene};
use crate::{api, export, fleet, frames, hub, notify, toml_file};

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
#[command(
    after_help = "Examples:\n  oapwatch check oapwatch.toml\n  oapwatch check --json config/scenes/paper.toml\n  oapwatch check --send oapwatch.toml"
)]
pub struct Args {
    /// A config or scene
    file: PathBuf,
    /// Print one JSON object instead of a sentence, also where the file is refused
    #[arg(long)]
    json: bool,
    /// Send an event that is marked as a test to every webhook and export of the config, and say what came back
    #[arg(long)]
    send: bool,
}

/// What a file describes.
struct Checked {
    sentence: String,
    facts: Value,
    warnings: Vec<String>,
    receivers: Vec<Endpoint>,
}

/// A file that can be used is described on stdout, with its probable mistakes on stderr.
pub fn run(args: Args) -> Outcome {
    let name = args.file.display();
    let checked = check(&args.file);
    let mut out = std::io::stdout().lock();
    if args.json {
        let mut object = json!({ "file": name.to_string(), "valid": checked.is_ok() });
        match &checked {
            Ok(checked) => {
                object["warnings"] = json!(checked.warnings);
                for (key, value) in checked.facts.as_object().into_iter().flatten() {
                    object[key] = value.clone();
                }
            }
            Err(failure) => object["error"] = json!(failure.message()),
        }
        writeln!(out, "{object}").map_err(Failure::other)?;
    }
    let checked = checked?;
    if !args.json {
        writeln!(out, "{name}: {}", checked.sentence).map_err(Failure::other)?;
        for warning in &checked.warnings {
            eprintln!("oapwatch: {name}: warning: {warning}");
        }
    }
    match args.send {
        true => send(&checked.receivers, args.json, &mut out),
        false => Ok(()),
    }
}

/// Sends a test event to each receiver, one after the other.
fn send(receivers: &[Endpoint], json: bool, out: &mut impl Write) -> Outcome {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(Failure::other)?;
    let mut failed = 0;
    for receiver in receivers {
        let outcome = runtime.block_on(notify::send_test(
            receiver,
            "check",
            notify::Clock::wall(),
            std::time::Duration::MAX,
        ));
        failed += usize::from(!outcome.delivered);
        let Endpoint {
            name, kind, shown_url, ..
        } = receiver;
        let written = if json {
            writeln!(
                out,
                "{}",
                json!({ "name": name, "kind": kind, "address": shown_url, "outcome": outcome })
            )
        } else {
            let said = match (&outcome.error, outcome.status) {
                (Some(error), _) => format!("NOT delivered: {error}"),
                (None, Some(status)) => format!("delivered in {} ms; the receiver answered {status}", outcome.took_ms),
                // Datagrams and plain streams are not answered.
                (None, None) => format!("sent in {} ms; look there whether it arrived", outcome.took_ms),
            };
            writeln!(out, "{kind} {name} ({shown_url}): {said}")
        };
        written.map_err(Failure::other)?;
    }
    if receivers.is_empty() {
        eprintln!("oapwatch: there is no [[webhook]] or [[export]] to send to");
    }
    match failed {
        0 => Ok(()),
        _ => Err(Failure::other(anyhow::anyhow!(
            "{failed} of {} test events were not delivered",
            receivers.len()
        ))),
    }
}

fn check(file: &Path) -> Result<Checked, Failure> {
    let table: toml::Table = toml_file::read(file).map_err(Failure::config)?;
    match OF_SCENES.iter().any(|key| table.contains_key(*key)) {
        true => scene(file),
        false => config(file),
    }
}

fn scene(file: &Path) -> Result<Checked, Failure> {
    let scene = Scene::load(file).map_err(Failure::config)?;
    Plan::compile(&scene, 0).map_err(Failure::config)?;
    let (users, intruders) = (scene.user.len(), scene.intruder.len());
    Ok(Checked {
        sentence: format!("a scene, {users} users and {intruders} intruders"),
        facts: json!({ "kind": "scene", "users": users, "intruders": intruders, "rate_hz": scene.rate_hz }),
        warnings: Vec::new(),
        receivers: Vec::new(),
    })
}

fn config(file: &Path) -> Result<Checked, Failure> {
    let config = Config::load(file).map_err(Failure::config)?;
    config.log.filter().map_err(Failure::config)?;
    config.journal.validate().map_err(Failure::config)?;
    api::Server::new(config.api.clone()).map_err(Failure::config)?;
    api::Background::open(&config.api.background, config.world.axes().as_ref()).map_err(Failure::config)?;
    let mut receivers = notify::load(&config.webhook).map_err(Failure::config)?;
    let exports = export::load(&config.export, &receivers, &config.world).map_err(Failure::config)?;
    receivers.extend(exports.into_iter().map(|export| export.endpoint));
    let is_hub = config.fleet.url.is_some() && config.fleet.station.is_none();
    match is_hub {
        true => hub_config(&config, receivers),
        false => station_config(&config, receivers),
    }
}

/// With a server and without a station's name it is for `oapwatch fleet`.
fn hub_config(config: &Config, receivers: Vec<Endpoint>) -> Result<Checked, Failure> {
    hub::validate(config).map_err(Failure::config)?;
    let url = config.fleet.url.as_deref().unwrap_or_default();
    let sites = config.fleet.site.as_deref().unwrap_or("all sites");
    Ok(Checked {
        sentence: format!("a config of a hub (oapwatch fleet); {sites}, over {url}"),
        facts: json!({ "kind": "hub", "url": url, "site": config.fleet.site }),
        warnings: Vec::new(),
        receivers,
    })
}

fn station_config(config: &Config, receivers: Vec<Endpoint>) -> Result<Checked, Failure> {
    fleet::Station::new(&config.fleet).map_err(Failure::config)?;
    let camera = config.camera().map_err(Failure::config)?;
    let pipeline = Pipeline::new(config, &camera).map_err(Failure::config)?;
    frames::open(&config.source, &camera).map_err(Failure::config)?;
    config.platform.telemetry().map_err(Failure::config)?;
    let (pixels, source, estimator) = (
        [camera.x.n, camera.y.n],
        config.source.kind.name(),
        pipeline.estimator(),
    );
    Ok(Checked {
        sentence: format!(
            "a config; {} × {} pixels, source {source}, estimator {estimator}",
            pixels[0], pixels[1]
        ),
        facts: json!({ "kind": "config", "pixels": pixels, "source": source, "estimator": estimator }),
        warnings: [config.warnings(&camera), pipeline.warnings()].concat(),
        receivers,
    })
}
