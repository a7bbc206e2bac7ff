//! Layer 2: sources of frames (simulator, V4L2 device, recording), the `.npy` format and the recorder.

mod capture;
mod config;
mod error;
pub mod npy;
pub mod record;
mod replay;
mod simulator;
mod slot;
mod source;
pub mod v4l2;

pub use capture::Capture;
pub use config::{Config, SourceKind};
pub use error::Error;
pub use simulator::Simulator;
pub use slot::Captured;
pub use source::{FrameSource, Next};

use crate::optics::Camera;

/// Opens the configured source. An absent device is not an error: the source waits for it.
pub fn open(config: &Config, camera: &Camera) -> Result<Box<dyn FrameSource>, Error> {
    match config.kind {
        SourceKind::Replay => replay::open(config, camera.joules_per_count),
        SourceKind::V4l2 => Ok(Box::new(v4l2::V4l2::new(config, camera)?)),
        SourceKind::Simulator => Ok(Box::new(Simulator::open(config, camera)?)),
    }
}
