//! `oapwatch claims`: what is understood of a claims log, and why the rest is refused.

use std::io::Write;
use std::path::PathBuf;

use super::{Failure, Outcome};
use crate::claim::escape_undisplayable;
use crate::claims::{self, Claim, ClaimState, Format};
use crate::config::Config;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch claims --config oapwatch.toml\n  oapwatch claims --format gad --config oapwatch.toml positions.ndjson"
)]
pub struct Args {
    /// The log; the config's own when left out
    file: Option<PathBuf>,
    /// The config whose [claims] says how lines are read
    #[arg(long)]
    config: Option<PathBuf>,
    /// oapwatch, gad, cisco-spaces, cot or csv, in place of the config's
    #[arg(long, value_parser = format)]
    format: Option<Format>,
    /// Claims and refused lines to print
    #[arg(long, default_value_t = 10)]
    lines: usize,
}

fn format(name: &str) -> Result<Format, String> {
    Format::named(name).ok_or_else(|| "expected oapwatch, gad, cisco-spaces, cot or csv".to_owned())
}

/// Prints the first claims by time, then the first lines that are none with the reason.
pub fn run(args: Args) -> Outcome {
    let mut config = match &args.config {
        Some(path) => Config::load(path).map_err(Failure::config)?.claims,
        None => claims::Config::default(),
    };
    config.validate().map_err(Failure::config)?;
    config.format = args.format.unwrap_or(config.format);
    let Some(file) = args.file.or_else(|| config.log.clone()) else {
        return Err(Failure::input(anyhow::anyhow!(
            "expected a FILE, or --config with claims.log; found neither"
        )));
    };
    let read = claims::read_log(&file, &config, None);
    let read = read.map_err(|e| Failure::input(anyhow::anyhow!("{}: {e}", file.display())))?;
    let mut out = std::io::stdout().lock();
    let mut print = |line: String| writeln!(out, "{line}").map_err(Failure::other);
    for claim in read.claims.iter().take(args.lines) {
        print(sentence(claim, &config))?;
    }
    for refused in read.refused.iter().take(args.lines) {
        print(format!("line {}: refused: {}", refused.line, refused.error))?;
    }
    print(format!(
        "{}: {} claims understood, {} lines refused",
        file.display(),
        read.claims.len(),
        read.refused_count
    ))?;
    match read.claims.is_empty() && read.refused_count > 0 {
        true => Err(Failure::input(anyhow::anyhow!(
            "{}: no line is a claim",
            file.display()
        ))),
        false => Ok(()),
    }
}

/// `u-17 at x 12.50 m, y -80.00 m, ± 1.00 m, 2026-11-21T08:00:00Z, active`.
fn sentence(claim: &Claim, config: &claims::Config) -> String {
    let error = match (claim.cov_m2, claim.sigma_m) {
        (Some([[a, b], [_, c]]), _) => {
            let (mean, half) = (0.5 * (a + c), (0.5 * (a - c)).hypot(b));
            // The longer axis, clockwise from y.
            let bearing = (0.5 * (2.0 * b).atan2(c - a)).to_degrees().rem_euclid(180.0);
            format!(
                "± {:.2} m and {:.2} m across, longer towards {bearing:.0}°",
                (mean + half).sqrt(),
                (mean - half).max(0.0).sqrt()
            )
        }
        (None, Some(sigma)) => format!("± {sigma:.2} m"),
        (None, None) => format!("± {:.2} m, not stated", config.default_sigma_m),
    };
    let state = match claim.state {
        ClaimState::Active => "active",
        ClaimState::Ended => "ended",
    };
    format!(
        "{} at x {:.2} m, y {:.2} m, {error}, {}, {state}",
        escape_undisplayable(&claim.user),
        claim.x_m,
        claim.y_m,
        claim.time
    )
}
