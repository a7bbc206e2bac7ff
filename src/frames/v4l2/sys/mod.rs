//! The kernel's V4L2 calls as safe functions, through the `v4l` crate's ioctl layer. That crate's `Device`,
//! `Stream` and `Arena` are not used: their `Drop` panics on most errors, a stream is unusable after a timeout
//! or a signal, `format()` panics on unknown colour spaces and multi-planar devices are refused.
//!
//! This is the only room with unsafe code: ioctls take a pointer to a C struct, replies come in unions, and
//! buffers are mapped memory. Each block says why it is sound.
#![allow(unsafe_code)]

mod node;
mod stream;

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::time::Duration;

use v4l::v4l_sys as c;
use v4l::v4l2::{self, vidioc};

pub use node::{Format, Node, Sizes};
pub use stream::{Meta, Stream};

/// Plain C structs of integers, for which all zeroes is a value.
trait Zeroed: Sized {
    fn zeroed() -> Self {
        // SAFETY: implemented below for structs of integers, integer unions and nullable raw pointers only.
        unsafe { std::mem::zeroed() }
    }
}
impl Zeroed for c::v4l2_capability {}
impl Zeroed for c::v4l2_fmtdesc {}
impl Zeroed for c::v4l2_frmsizeenum {}
impl Zeroed for c::v4l2_format {}
impl Zeroed for c::v4l2_streamparm {}
impl Zeroed for c::v4l2_queryctrl {}
impl Zeroed for c::v4l2_requestbuffers {}
impl Zeroed for c::v4l2_buffer {}
impl Zeroed for c::v4l2_plane {}

/// `argument` must be the struct that `request` is defined for: every call in this room pairs them as the V4L2
/// headers do, and the request number carries the struct's size.
fn ioctl<T>(fd: &File, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
    // SAFETY: the pointer is to a live, exclusively borrowed struct of the size encoded in the request.
    unsafe { v4l2::ioctl(fd.as_raw_fd(), request, std::ptr::from_mut(argument).cast()) }
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

/// Time since an arbitrary start, on the clock that drivers stamp frames with.
pub fn monotonic() -> Duration {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes to one live timespec.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut now) };
    Duration::new(now.tv_sec.max(0) as u64, now.tv_nsec.clamp(0, 999_999_999) as u32)
}
