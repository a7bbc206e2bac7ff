//! `oapwatch simulate`: writes the frames, truth and claims of a scene.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use jiff::Timestamp;

use super::simulated_recording::Recording;
use super::{Failure, Outcome, progress};
use crate::scene::{Plan, Scene};

#[derive(Debug, clap::Args)]
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
    /// Folder for frames.npy (f8, J), truth.ndjson and claims.ndjson; made when it is not there, files are replaced
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
    let interrupted = watch_for_interrupt().map_err(Failure::other)?;
    let shape = plan.camera().shape();
    let mut recording = Recording::create(&args.out, shape).map_err(Failure::other)?;

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
    eprintln!("{next} frames in {}", args.out.display());
    Ok(())
}

/// Becomes true on Ctrl-C or SIGTERM.
fn watch_for_interrupt() -> std::io::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let raised = Arc::clone(&flag);
    let mut terminate = {
        let _inside = runtime.enter();
        tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?
    };
    std::thread::spawn(move || {
        runtime.block_on(async {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
        });
        raised.store(true, Ordering::Relaxed);
    });
    Ok(flag)
}
