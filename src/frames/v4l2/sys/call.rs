//! One ioctl, and the C structs that it fills.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;

use v4l::v4l_sys as c;
use v4l::v4l2::{self, vidioc};

/// Plain C structs of integers, for which all zeroes is a value.
pub trait Zeroed: Sized {
    fn zeroed() -> Self {
        // SAFETY: implemented below for structs of integers, integer unions and nullable raw pointers only.
        unsafe { std::mem::zeroed() }
    }
}
impl Zeroed for c::v4l2_capability {}
impl Zeroed for c::v4l2_fmtdesc {}
impl Zeroed for c::v4l2_frmsizeenum {}
impl Zeroed for c::v4l2_frmivalenum {}
impl Zeroed for c::v4l2_format {}
impl Zeroed for c::v4l2_streamparm {}
impl Zeroed for c::v4l2_queryctrl {}
impl Zeroed for c::v4l2_requestbuffers {}
impl Zeroed for c::v4l2_buffer {}
impl Zeroed for [c::v4l2_plane; 8] {}

/// `argument` must be the struct that `request` is defined for: every call in this module pairs them as the V4L2
/// headers do, and the request number carries the struct's size.
pub fn ioctl<T>(fd: &File, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
    // SAFETY: the pointer is to a live, exclusively borrowed struct of the size encoded in the request.
    unsafe { v4l2::ioctl(fd.as_raw_fd(), request, std::ptr::from_mut(argument).cast()) }
}

pub fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}
