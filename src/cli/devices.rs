//! `oapwatch devices`: lists V4L2 devices with their formats and sizes.

use std::io::Write;
use std::path::Path;

use serde_json::{Value, json};

use super::{Failure, Outcome};
use crate::frames::v4l2::{Device, Sizes, devices};

#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  oapwatch devices\n  oapwatch devices --all --json")]
pub struct Args {
    /// Also list formats that cannot be a source (colour, compressed)
    #[arg(long)]
    all: bool,
    /// Print a JSON list instead
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Outcome {
    let found = devices().map_err(|e| Failure::other(anyhow::Error::new(e).context("/dev")))?;
    let mut out = std::io::stdout().lock();
    let printed = if args.json {
        let devices = found.iter().map(|(path, device)| object(path, device, args.all));
        writeln!(out, "{}", devices.collect::<Value>())
    } else if found.is_empty() {
        writeln!(out, "no V4L2 device: there is no /dev/video*")
    } else {
        found.iter().try_for_each(|(path, device)| match device {
            Ok(device) => print(&mut out, &path.display().to_string(), device, args.all),
            Err(error) => writeln!(out, "{}: {error}", path.display()),
        })
    };
    printed.map_err(Failure::other)
}

fn object(path: &Path, device: &std::io::Result<Device>, all: bool) -> Value {
    let path = path.display().to_string();
    let device = match device {
        Ok(device) => device,
        Err(error) => return json!({ "path": path, "error": error.to_string() }),
    };
    let formats = device.formats.iter().filter(|f| all || f.usable).map(|f| {
        let sizes: Value = f.sizes.iter().map(size).collect();
        json!({ "name": f.name, "description": f.description, "usable": f.usable, "sizes": sizes })
    });
    json!({
        "path": path,
        "card": device.card,
        "driver": device.driver,
        "bus": device.bus,
        "captures": device.captures,
        "formats": formats.collect::<Value>(),
    })
}

fn print(out: &mut impl Write, path: &str, device: &Device, all: bool) -> std::io::Result<()> {
    writeln!(out, "{path}: {} ({}, {})", device.card, device.driver, device.bus)?;
    if !device.captures {
        return writeln!(out, "  does not capture video by streaming");
    }
    let shown: Vec<_> = device.formats.iter().filter(|f| all || f.usable).collect();
    for format in &shown {
        let sizes: Vec<_> = format.sizes.iter().map(size).collect();
        let sizes = match sizes.is_empty() {
            true => "sizes not listed by the driver".to_owned(),
            false => sizes.join(", "),
        };
        let usable = if format.usable { "" } else { " (cannot be a source)" };
        writeln!(out, "  {:7} {sizes}{usable}  {}", format.name, format.description)?;
    }
    let hidden = device.formats.len() - shown.len();
    match (shown.is_empty(), hidden) {
        (_, 0) => Ok(()),
        (true, n) => writeln!(
            out,
            "  no usable format (GREY, Y10, Y12, Y16, Y16_BE) among {n}; --all lists them"
        ),
        (false, n) => writeln!(out, "  and {n} formats that cannot be a source; --all lists them"),
    }
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
