//! `oapwatch review`: runs the whole chain over a recording and prints the alert events.

use std::io::Write;
use std::iter::from_fn;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::anyhow;

use super::{Failure, Outcome, progress};
use crate::claims::{self, read_log};
use crate::config::Config;
use crate::frames::{self, Next, SourceKind};
use crate::monitor::AlertEvent;
use crate::pipeline::Pipeline;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch simulate --scene config/scenes/eavesdropper.toml --frames 300 --out out\n  oapwatch review --config out/oapwatch.toml"
)]
pub struct Args {
    /// Config with a replay source
    #[arg(long)]
    config: PathBuf,
}

/// Runs the daemon's chain over a recording. A claim takes effect at its own time, so that the same input gives the same bytes at
/// any speed.
pub fn run(args: Args) -> Outcome {
    let mut config = Config::load(&args.config).map_err(Failure::config)?;
    let camera = config.optics.camera().map_err(Failure::config)?;
    if config.source.kind != SourceKind::Replay {
        return Err(Failure::config(anyhow!(
            "source.kind: review needs \"replay\", found {:?}",
            config.source.kind.name()
        )));
    }
    config.source.speed = 0.0;
    config.source.r#loop = false;
    let mut pipeline = Pipeline::new(&config, &camera).map_err(Failure::config)?;
    for warning in pipeline.warnings() {
        eprintln!("oapwatch: {}: warning: {warning}", args.config.display());
    }
    let mut source = frames::open(&config.source, &camera).map_err(|e| match e.is_config() {
        true => Failure::config(e),
        false => Failure::input(e),
    })?;
    let mut upcoming = claims_of(&config.claims, config.source.start)?.into_iter().peekable();
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    let bar = progress::count("frames");
    let (mut usable, mut first_error) = (0_u64, None);
    loop {
        let next = source.next(Duration::from_secs(1));
        pipeline.monitor.recorded_in(source.file());
        let report = match next {
            Next::Frame(frame, arrivals) => {
                pipeline.claim(from_fn(|| upcoming.next_if(|c| c.time <= frame.time)), frame.time);
                pipeline.claim(arrivals.claims, frame.time);
                pipeline.receive_poses(arrivals.poses, frame.time);
                let step = pipeline.step(&frame);
                match step.estimate {
                    Ok(_) => usable += 1,
                    Err(e) => drop(first_error.get_or_insert(e)),
                }
                step.report
            }
            Next::Unusable {
                index,
                time,
                reason,
                arrivals,
            } => {
                pipeline.claim(from_fn(|| upcoming.next_if(|c| c.time <= time)), time);
                pipeline.claim(arrivals.claims, time);
                pipeline.receive_poses(arrivals.poses, time);
                pipeline.unusable(index, time, &reason)
            }
            Next::Nothing => continue,
            Next::End => break,
        };
        print(&mut out, &report.events).map_err(Failure::other)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    out.flush().map_err(Failure::other)?;
    match (source.failure(), first_error) {
        (Some(reason), _) => Err(Failure::input(anyhow!("{reason}"))),
        (None, Some(e)) if usable == 0 => Err(Failure::input(anyhow!("no frame can be used; the first: {e}"))),
        _ => Ok(()),
    }
}

fn claims_of(config: &claims::Config, start: Option<jiff::Timestamp>) -> Result<Vec<claims::Claim>, Failure> {
    let Some(path) = &config.log else {
        return Ok(Vec::new());
    };
    let log = read_log(path, config, start).map_err(|e| {
        Failure::input(anyhow!(
            "claims log {}: expected a readable file, found: {e}",
            path.display()
        ))
    })?;
    for refused in &log.refused {
        eprintln!(
            "oapwatch: {}:{}: {}; skipped",
            path.display(),
            refused.line,
            refused.error
        );
    }
    let unnamed = log.refused_count - log.refused.len() as u64;
    if unnamed > 0 {
        eprintln!("oapwatch: {}: {unnamed} more malformed lines skipped", path.display());
    }
    Ok(log.claims)
}

fn print(out: &mut impl Write, events: &[AlertEvent]) -> std::io::Result<()> {
    for event in events {
        serde_json::to_writer(&mut *out, event)?;
        out.write_all(b"\n")?;
    }
    Ok(())
}
