//! Layer 2: sources of frames (simulator, V4L2 device, recording), the `.npy` format and the recorder.

mod capture;
mod config;
mod error;
pub mod npy;
pub mod record;
#[allow(clippy::disallowed_methods, reason = "frames are paced by their clock")]
mod replay;
#[allow(clippy::disallowed_methods, reason = "frames are paced by their clock")]
mod simulator;
#[allow(
    clippy::disallowed_methods,
    reason = "a wait has an end, and a frame's age is a metric"
)]
mod slot;
mod source;
#[allow(
    clippy::disallowed_methods,
    reason = "a device's silence is measured, its clock compared"
)]
pub mod v4l2;

pub use capture::Capture;
pub use config::{Config, SourceKind};
pub use error::Error;
pub use replay::{frame_time, holds_times};
pub use simulator::Simulator;
pub use slot::Captured;
pub use source::{Arrivals, FrameSource, Next};

use crate::optics::Camera;

/// Opens the configured source. An absent device is not an error: the source waits for it.
pub fn open(config: &Config, camera: &Camera) -> Result<Box<dyn FrameSource>, Error> {
    match config.kind {
        SourceKind::Replay => replay::open(config, camera.joules_per_count),
        SourceKind::V4l2 => Ok(Box::new(v4l2::V4l2::new(config, camera)?)),
        SourceKind::Simulator => Ok(Box::new(Simulator::open(config, camera)?)),
    }
}
