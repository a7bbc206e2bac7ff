//! `oapwatch simulate`: writes the frames, truth, claims and poses of a scene.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::Context;
use jiff::Timestamp;

use super::simulated_recording::Recording;
use super::{Failure, Outcome, interrupt, progress};
use crate::scene::{Plan, Scene};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch simulate --scene config/scenes/paper.toml --frames 100 --seed 1 --out out"
)]
pub struct Args {
    /// A scene file
    #[arg(long)]
    scene: PathBuf,
    /// How many frames
    #[arg(long)]
    frames: u64,
    /// The same seed gives the same frames
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for frames.npy (f8, J), truth.ndjson, claims.ndjson, poses.ndjson where the platform moves, and oapwatch.toml, a config with which `review` runs on them;
    /// made when it is not there, files are replaced, except a config of another origin
    #[arg(long)]
    out: PathBuf,
    /// Time of frame 0
    #[arg(long, default_value = "2026-01-01T00:00:00Z")]
    start: Timestamp,
}

/// Pixels held in memory at a time, over all frames of a batch.
const BATCH_PIXELS: usize = 1 << 20;

pub fn run(args: Args) -> Outcome {
    let scene = Scene::load(&args.scene).map_err(Failure::config)?;
    let plan = Plan::compile(&scene, args.seed).map_err(Failure::config)?;
    let plan = plan.starting_at(args.start);
    let interrupted = interrupt::watch().map_err(Failure::other)?;
    let shape = plan.camera().shape();
    let mut recording = Recording::create(&args.out, shape, scene.platform.is_some()).map_err(Failure::other)?;

    let bar = progress::bar(args.frames, "frames");
    let batch = (BATCH_PIXELS / (shape.0 * shape.1)).clamp(1, 256) as u64;
    let mut next = 0;
    while next < args.frames && !interrupted.load(Ordering::Relaxed) {
        let end = args.frames.min(next + batch);
        if let Err(e) = recording.append(&plan.frames(next, end)) {
            bar.abandon();
            let kept = recording.frames();
            return Err(Failure::other(anyhow::Error::new(e).context(format!(
                "{kept} of {} frames were written to {}, and the files are valid",
                args.frames,
                args.out.display()
            ))));
        }
        bar.inc(end - next);
        next = end;
    }
    bar.finish_and_clear();
    if next < args.frames {
        return Err(Failure::other(anyhow::anyhow!(
            "interrupted: {next} of {} frames were written to {}, and the files are valid",
            args.frames,
            args.out.display()
        )));
    }
    if let Some(last) = next.checked_sub(1) {
        recording
            .append_poses(&plan.poses_after(last))
            .map_err(Failure::other)?;
    }
    eprintln!("{next} frames in {}", args.out.display());
    let config = args.out.join("oapwatch.toml");
    match write_config(&config, &scene, args.start).map_err(Failure::other)? {
        true => eprintln!("oapwatch review --config {} replays them", config.display()),
        false => eprintln!("{} was there already and is left as it is", config.display()),
    }
    Ok(())
}

/// First line of a config written here; one without it belongs to the user and is kept.
const CONFIG_HEAD: &str = "# Written by `oapwatch simulate`: replays the frames and claims beside it.";

/// Writes a config that replays the recording. `false` when a config of the user is in its place.
fn write_config(path: &Path, scene: &Scene, start: Timestamp) -> anyhow::Result<bool> {
    match std::fs::read_to_string(path) {
        Ok(text) if !text.starts_with(CONFIG_HEAD) => return Ok(false),
        Err(e) if e.kind() != ErrorKind::NotFound => return Err(e).with_context(|| path.display().to_string()),
        _ => {}
    }
    let optics = toml::to_string(&scene.optics).context("the scene's [optics] as TOML")?;
    let platform = match &scene.platform {
        Some(moving) => {
            let mount = toml::Table::try_from(moving.mount).context("the scene's mount as TOML")?;
            format!("[platform]\nkind = \"replay\"\nposes = \"poses.ndjson\"\n[platform.mount]\n{mount}\n")
        }
        None => String::new(),
    };
    let exposure = match scene.effects.motion_blur {
        Some(_) => format!("exposure_s = {:?}\n", scene.link.integration_time_s),
        None => String::new(),
    };
    // A table below [optics] would take in the keys after it, so it comes last.
    let text = format!(
        "{CONFIG_HEAD}\n\n[source]\nkind = \"replay\"\nframes = \"frames.npy\"\nstart = \"{start}\"\nrate_hz = {:?}\n{exposure}\n\
         [claims]\nlog = \"claims.ndjson\"\n\n{platform}[optics]\n{}",
        scene.rate_hz,
        optics.replace("[blur]", "[optics.blur]"),
    );
    std::fs::write(path, text).with_context(|| path.display().to_string())?;
    Ok(true)
}
