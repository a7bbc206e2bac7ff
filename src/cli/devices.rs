//! `oapwatch devices`: lists V4L2 devices with their formats and sizes.

use std::io::Write;
use std::path::Path;

use serde_json::{Value, json};

use super::{Failure, Outcome};
use crate::frames::Config;
use crate::frames::v4l2::{Device, Offer, Sizes, devices, why};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch devices\n  oapwatch devices --rate-hz 60\n  oapwatch devices --all --json"
)]
pub struct Args {
    /// Also list formats that cannot be a source
    #[arg(long)]
    all: bool,
    /// Frame rate that the best format must keep, as `[source] rate_hz` asks for
    #[arg(long, default_value_t = Config::DEFAULT_RATE_HZ)]
    rate_hz: f64,
    /// Print a JSON list instead
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Outcome {
    let found = devices(args.rate_hz).map_err(|e| Failure::other(anyhow::Error::new(e).context("/dev")))?;
    let mut out = std::io::stdout().lock();
    let printed = if args.json {
        let devices = found.iter().map(|(path, device)| object(path, device, &args));
        writeln!(out, "{}", devices.collect::<Value>())
    } else if found.is_empty() {
        writeln!(out, "no V4L2 device: there is no /dev/video*")
    } else {
        found.iter().try_for_each(|(path, device)| match device {
            Ok(device) => print(&mut out, &path.display().to_string(), device, &args),
            Err(error) => writeln!(out, "{}: {error}", path.display()),
        })
    };
    printed.map_err(Failure::other)
}

fn object(path: &Path, device: &std::io::Result<Device>, args: &Args) -> Value {
    let path = path.display().to_string();
    let device = match device {
        Ok(device) => device,
        Err(error) => return json!({ "path": path, "error": error.to_string() }),
    };
    let formats = device.formats.iter().filter(|f| args.all || f.usable.is_some()).map(|f| {
        let sizes: Value = f.sizes.iter().map(size).collect();
        let keeps = f.usable.map(|format| format.says());
        json!({ "name": f.name, "description": f.description, "usable": keeps.is_some(), "keeps": keeps, "sizes": sizes })
    });
    let ranked = device.ranked.iter().map(
        |o| json!({ "pixel_format": o.format, "size": o.size, "rate_hz": o.rate_hz, "keeps": o.says(args.rate_hz) }),
    );
    json!({
        "path": path,
        "card": device.card,
        "driver": device.driver,
        "bus": device.bus,
        "captures": device.captures,
        "formats": formats.collect::<Value>(),
        "best_first": ranked.collect::<Value>(),
        "best_because": because(device, args),
    })
}

fn print(out: &mut impl Write, path: &str, device: &Device, args: &Args) -> std::io::Result<()> {
    writeln!(out, "{path}: {} ({}, {})", device.card, device.driver, device.bus)?;
    if !device.captures {
        return writeln!(out, "  does not capture video by streaming");
    }
    let shown: Vec<_> = device
        .formats
        .iter()
        .filter(|f| args.all || f.usable.is_some())
        .collect();
    if let Some(best) = device.ranked.first() {
        let because = because(device, args).map_or_else(String::new, |why| format!("; {why}"));
        writeln!(out, "  best: {}{because}", named(best))?;
        writeln!(out, "        {}", best.says(args.rate_hz))?;
    }
    for format in &shown {
        let sizes: Vec<_> = format.sizes.iter().map(size).collect();
        let sizes = match sizes.is_empty() {
            true => "sizes not listed by the driver".to_owned(),
            false => sizes.join(", "),
        };
        let keeps = match format.usable {
            Some(format) => format.says(),
            None => "cannot be a source".to_owned(),
        };
        writeln!(out, "  {:7} {sizes}  {} ({keeps})", format.name, format.description)?;
    }
    let hidden = device.formats.len() - shown.len();
    match (shown.is_empty(), hidden) {
        (_, 0) => Ok(()),
        (true, n) => writeln!(
            out,
            "  no usable format (grey, Bayer, YUYV, UYVY, NV12, NV16, MJPG) among {n}; --all lists them"
        ),
        (false, n) => writeln!(out, "  and {n} formats that cannot be a source; --all lists them"),
    }
}

fn named(offer: &Offer) -> String {
    format!("{} {}×{}", offer.format.name(), offer.size[0], offer.size[1])
}

/// Why the best offer is before the next of another format, or of another size where there is one format only.
fn because(device: &Device, args: &Args) -> Option<String> {
    let (best, others) = device.ranked.split_first()?;
    let next = others.iter().find(|o| o.format != best.format).or(others.first())?;
    Some(why(best, next, args.rate_hz))
}

fn size(size: &Sizes) -> String {
    match size {
        Sizes::One { width, height } => format!("{width}×{height}"),
        Sizes::Range { min, max, step } => format!(
            "{}×{} to {}×{} in steps of {}×{}",
            min[0], min[1], max[0], max[1], step[0], step[1]
        ),
    }
}
