//! Arguments of `oapwatch calibrate`.

use std::path::PathBuf;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  oapwatch calibrate --config oapwatch.toml --out calibration.toml --picture spot.svg frames.npy\n  oapwatch calibrate --config oapwatch.toml --truth positions.ndjson \\\n    --out calibration.toml frames.npy"
)]
pub struct Args {
    /// Config with the data sheet of the device; the result must improve on a calibration that it names
    #[arg(long)]
    pub(super) config: PathBuf,
    /// NDJSON with the known positions of each frame: the geometry is fitted as well. Without it the spot's shape, the noise and the pixels
    /// are learned from the frames alone
    #[arg(long)]
    pub(super) truth: Option<PathBuf>,
    /// Where to write the calibration
    #[arg(long)]
    pub(super) out: PathBuf,
    /// Draw the spot, its change over the field, the residuals and the encircled energy into this SVG file
    #[arg(long, value_name = "FILE.svg")]
    pub(super) picture: Option<PathBuf>,
    /// Print one JSON object instead of sentences
    #[arg(long)]
    pub(super) json: bool,
    /// FRAMES.npy; without --truth also a folder that `[record]` wrote
    pub(super) frames: PathBuf,
}
