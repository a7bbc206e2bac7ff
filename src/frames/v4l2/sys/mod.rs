//! The kernel's V4L2 calls as safe functions, through the `v4l` crate's ioctl layer. That crate's `Device`,
//! `Stream` and `Arena` are not used: their `Drop` panics on most errors, a stream is unusable after a timeout
//! or a signal, `format()` panics on unknown colour spaces and multi-planar devices are refused.
//!
//! This is the only module with unsafe code: ioctls take a pointer to a C struct, replies come in unions, and buffers are mapped
//! memory. Each block states why it is sound.
#![allow(unsafe_code)]

mod call;
mod node;
mod stream;

use std::time::Duration;

pub use node::{Colour, Format, Node, Sizes};
pub use stream::{Meta, Stream};

/// Time since an arbitrary start, on the clock that drivers stamp frames with.
pub fn monotonic() -> Duration {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes to one live timespec.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut now) };
    Duration::new(now.tv_sec.max(0) as u64, now.tv_nsec.clamp(0, 999_999_999) as u32)
}
