//! What no frame shows: altitude and lens. Flags, or answers on a terminal.

use std::io::{IsTerminal, Write};

use anyhow::anyhow;

use crate::cli::Failure;

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Height of the lens above the ground
    #[arg(long)]
    altitude_m: Option<f64>,
    /// Angle that the whole image spans along its width; or focal length and pixel pitch
    #[arg(long, conflicts_with_all = ["focal_length_m", "pixel_pitch_m"])]
    field_of_view_deg: Option<f64>,
    /// Focal length of the lens, focused far away
    #[arg(long, requires = "pixel_pitch_m")]
    focal_length_m: Option<f64>,
    /// Distance of two camera pixels
    #[arg(long, requires = "focal_length_m")]
    pixel_pitch_m: Option<f64>,
}

/// Height and lens.
#[derive(Clone, Copy, Debug)]
pub struct Geometry {
    pub altitude_m: f64,
    pub lens: Lens,
}

#[derive(Clone, Copy, Debug)]
pub enum Lens {
    Measures { focal_length_m: f64, pixel_pitch_m: f64 },
    FieldOfView { rad: f64 },
}

/// Pixel pitch where only the field of view is known: positions on the ground do not depend on it.
pub const NOMINAL_PITCH_M: f64 = 3e-6;

impl Geometry {
    /// Takes the flags and asks for what is missing.
    pub fn ask(args: &Args) -> Result<Self, Failure> {
        let altitude_m = number(
            "altitude-m",
            "Height of the lens above the ground, m",
            args.altitude_m,
            0.01..=1e5,
        )?;
        let lens = match (args.focal_length_m, args.pixel_pitch_m) {
            (Some(focal), Some(pitch)) => Lens::Measures {
                focal_length_m: number("focal-length-m", "", Some(focal), 1e-5..=100.0)?,
                pixel_pitch_m: number("pixel-pitch-m", "", Some(pitch), 1e-8..=0.1)?,
            },
            _ => {
                let question = "Angle that the image spans along its width, degrees";
                let degrees = number("field-of-view-deg", question, args.field_of_view_deg, 0.01..=170.0)?;
                Lens::FieldOfView {
                    rad: degrees.to_radians(),
                }
            }
        };
        Ok(Self { altitude_m, lens })
    }

    /// Distance from lens to sensor and pixel pitch, m, of an image that is `width` camera pixels wide.
    pub fn plane_and_pitch_m(&self, width: usize) -> [f64; 2] {
        match self.lens {
            Lens::Measures {
                focal_length_m,
                pixel_pitch_m,
            } => [focal_length_m, pixel_pitch_m],
            Lens::FieldOfView { rad } => {
                let half = 0.5 * width as f64 * NOMINAL_PITCH_M;
                [half / (0.5 * rad).tan(), NOMINAL_PITCH_M]
            }
        }
    }
}

/// A flag's value, or the answer of somebody at a terminal.
fn number(
    flag: &str,
    question: &str,
    given: Option<f64>,
    range: std::ops::RangeInclusive<f64>,
) -> Result<f64, Failure> {
    let (low, high) = (range.start(), range.end());
    let refuse = |found: &dyn std::fmt::Display| {
        Err(Failure::Input(anyhow!(
            "--{flag}: expected a number from {low} to {high}, found {found}"
        )))
    };
    if let Some(value) = given {
        return if range.contains(&value) {
            Ok(value)
        } else {
            refuse(&value)
        };
    }
    if !std::io::stdin().is_terminal() {
        return refuse(&"nothing, and no terminal to ask at");
    }
    loop {
        eprint!("{question}: ");
        let _ = std::io::stderr().flush();
        let mut line = String::new();
        if std::io::stdin().read_line(&mut line).map_err(Failure::other)? == 0 {
            return refuse(&"the end of the input");
        }
        match line.trim().parse() {
            Ok(value) if range.contains(&value) => return Ok(value),
            _ => eprintln!("expected a number from {low} to {high}"),
        }
    }
}
