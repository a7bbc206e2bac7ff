//! The spot of a calibration file.

use std::path::Path;

use serde::Deserialize;

use crate::optics::spot::{Layout, SpotShape};
use crate::toml_file::{self, Key, OutOfRange};

/// What a scene takes of a calibration file.
#[derive(Deserialize)]
struct Calibration {
    spot: Spot,
}

#[derive(Deserialize)]
struct Spot {
    shape: Option<Layout>,
}

/// Reads `[spot.shape]`; `key` names the file in messages.
pub fn read(file: &Path, key: &Key) -> Result<SpotShape, OutOfRange> {
    let refuse = |found: String| key.refuse("a calibration file with a learned spot ([spot.shape])", found);
    let calibration: Calibration = toml_file::read(file).map_err(|e| refuse(e.to_string()))?;
    let shape = calibration.spot.shape;
    let layout = shape.ok_or_else(|| refuse(format!("{}: a Gaussian", file.display())))?;
    layout
        .shape(&Key::new("spot.shape"))
        .map_err(|e| refuse(format!("{}: {e}", file.display())))
}
