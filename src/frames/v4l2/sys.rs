//! The kernel's V4L2 calls as safe functions, through the `v4l` crate's ioctl layer. That crate's `Device`,
//! `Stream` and `Arena` are not used: their `Drop` panics on most errors, a stream is unusable after a timeout
//! or a signal, `format()` panics on unknown colour spaces and multi-planar devices are refused.
//!
//! This is the only file with unsafe code: ioctls take a pointer to a C struct, replies come in unions, and
//! buffers are mapped memory. Each block says why it is sound.
#![allow(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::raw::c_void;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::ptr::NonNull;
use std::time::Duration;

use v4l::v4l_sys as c;
use v4l::v4l2::{self, vidioc};

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

/// What a node says it is.
#[derive(Clone, Debug)]
pub struct Capability {
    pub driver: String,
    pub card: String,
    pub bus: String,
    /// Captures video, in the single-planar or the multi-planar interface.
    pub captures: bool,
    pub streams: bool,
    multi_planar: bool,
}

/// A pixel format a node offers.
#[derive(Clone, Debug)]
pub struct Offered {
    pub fourcc: u32,
    pub description: String,
}

/// Frame sizes a node offers for a format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sizes {
    One {
        width: u32,
        height: u32,
    },
    Range {
        min: [u32; 2],
        max: [u32; 2],
        step: [u32; 2],
    },
}

/// An image format, as asked for or as granted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Format {
    pub fourcc: u32,
    pub width: u32,
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Bytes of a whole image.
    pub size: u32,
}

/// What the driver says about one filled buffer.
#[derive(Clone, Copy, Debug)]
pub struct Meta {
    pub flags: u32,
    pub sequence: u32,
    /// On the clock that `flags` names.
    pub timestamp: Duration,
}

/// An open device node, non-blocking.
#[derive(Debug)]
pub struct Node {
    fd: File,
    capability: Capability,
}

impl Node {
    pub fn open(path: &Path) -> io::Result<Self> {
        let fd = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(libc::O_NONBLOCK)
            .open(path)?;
        let mut raw = c::v4l2_capability::zeroed();
        ioctl(&fd, vidioc::VIDIOC_QUERYCAP, &mut raw)?;
        let caps = match raw.capabilities & c::V4L2_CAP_DEVICE_CAPS {
            0 => raw.capabilities,
            _ => raw.device_caps,
        };
        let single = caps & c::V4L2_CAP_VIDEO_CAPTURE != 0;
        let multi = caps & c::V4L2_CAP_VIDEO_CAPTURE_MPLANE != 0;
        let capability = Capability {
            driver: text(&raw.driver),
            card: text(&raw.card),
            bus: text(&raw.bus_info),
            captures: single || multi,
            streams: caps & c::V4L2_CAP_STREAMING != 0,
            multi_planar: !single && multi,
        };
        Ok(Self { fd, capability })
    }

    pub fn capability(&self) -> &Capability {
        &self.capability
    }

    fn buffer_type(&self) -> u32 {
        match self.capability.multi_planar {
            false => c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE,
            true => c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE,
        }
    }

    /// Pixel formats, as far as the node lists them.
    pub fn formats(&self) -> Vec<Offered> {
        let offered = |index| {
            let mut raw = c::v4l2_fmtdesc::zeroed();
            raw.index = index;
            raw.type_ = self.buffer_type();
            ioctl(&self.fd, vidioc::VIDIOC_ENUM_FMT, &mut raw).ok()?;
            Some(Offered {
                fourcc: raw.pixelformat,
                description: text(&raw.description),
            })
        };
        // A driver that never says EINVAL would list for ever.
        (0..256).map_while(offered).collect()
    }

    /// Frame sizes of a format, as far as the node lists them.
    pub fn sizes(&self, fourcc: u32) -> Vec<Sizes> {
        let size = |index| {
            let mut raw = c::v4l2_frmsizeenum::zeroed();
            raw.index = index;
            raw.pixel_format = fourcc;
            ioctl(&self.fd, vidioc::VIDIOC_ENUM_FRAMESIZES, &mut raw).ok()?;
            if raw.type_ == c::v4l2_frmsizetypes_V4L2_FRMSIZE_TYPE_DISCRETE {
                // SAFETY: the type says which member the kernel filled; both are integers.
                let d = unsafe { raw.__bindgen_anon_1.discrete };
                return Some(Sizes::One {
                    width: d.width,
                    height: d.height,
                });
            }
            // SAFETY: as above; stepwise and continuous share this member.
            let s = unsafe { raw.__bindgen_anon_1.stepwise };
            (index == 0).then_some(Sizes::Range {
                min: [s.min_width, s.min_height],
                max: [s.max_width, s.max_height],
                step: [s.step_width, s.step_height],
            })
        };
        (0..256).map_while(size).collect()
    }

    pub fn format(&self) -> io::Result<Format> {
        let mut raw = c::v4l2_format::zeroed();
        raw.type_ = self.buffer_type();
        ioctl(&self.fd, vidioc::VIDIOC_G_FMT, &mut raw)?;
        self.granted(&raw)
    }

    /// Asks for a format (stride and size are the driver's choice) and gives what was granted, which may be
    /// something else.
    pub fn set_format(&self, asked: Format) -> io::Result<Format> {
        let mut raw = c::v4l2_format::zeroed();
        raw.type_ = self.buffer_type();
        if self.capability.multi_planar {
            // SAFETY: writes one member of a union of plain structs in a zeroed struct.
            let pix = unsafe { &mut raw.fmt.pix_mp };
            (pix.width, pix.height, pix.pixelformat) = (asked.width, asked.height, asked.fourcc);
            pix.field = c::v4l2_field_V4L2_FIELD_NONE;
            pix.num_planes = 1;
        } else {
            // SAFETY: as above.
            let pix = unsafe { &mut raw.fmt.pix };
            (pix.width, pix.height, pix.pixelformat) = (asked.width, asked.height, asked.fourcc);
            pix.field = c::v4l2_field_V4L2_FIELD_NONE;
        }
        ioctl(&self.fd, vidioc::VIDIOC_S_FMT, &mut raw)?;
        self.granted(&raw)
    }

    fn granted(&self, raw: &c::v4l2_format) -> io::Result<Format> {
        if !self.capability.multi_planar {
            // SAFETY: the buffer type selects this member; it holds integers only.
            let pix = unsafe { raw.fmt.pix };
            return Ok(Format {
                fourcc: pix.pixelformat,
                width: pix.width,
                height: pix.height,
                stride: pix.bytesperline,
                size: pix.sizeimage,
            });
        }
        // SAFETY: as above, for the multi-planar buffer type.
        let pix = unsafe { raw.fmt.pix_mp };
        // Copied, since the struct is packed.
        let (plane, planes) = (pix.plane_fmt[0], pix.num_planes);
        if planes != 1 {
            return Err(io::Error::new(
                io::ErrorKind::Unsupported,
                format!("an image of {planes} planes; expected one"),
            ));
        }
        Ok(Format {
            fourcc: pix.pixelformat,
            width: pix.width,
            height: pix.height,
            stride: plane.bytesperline,
            size: plane.sizeimage,
        })
    }

    /// Asks for a frame interval, s, and gives the one granted; `None` where the device sets its own pace.
    pub fn set_interval(&self, seconds: f64) -> io::Result<Option<f64>> {
        let mut raw = c::v4l2_streamparm::zeroed();
        raw.type_ = self.buffer_type();
        ioctl(&self.fd, vidioc::VIDIOC_G_PARM, &mut raw)?;
        // SAFETY: the buffer type selects this member; it holds integers only.
        let capture = unsafe { &mut raw.parm.capture };
        if capture.capability & c::V4L2_CAP_TIMEPERFRAME != 0 {
            const UNITS: f64 = 1e6;
            capture.timeperframe.numerator = (seconds * UNITS).clamp(1.0, f64::from(u32::MAX)) as u32;
            capture.timeperframe.denominator = UNITS as u32;
            ioctl(&self.fd, vidioc::VIDIOC_S_PARM, &mut raw)?;
        }
        // SAFETY: as above.
        let granted = unsafe { raw.parm.capture.timeperframe };
        Ok((granted.denominator > 0 && granted.numerator > 0)
            .then(|| f64::from(granted.numerator) / f64::from(granted.denominator)))
    }

    /// Sets a control, held within its range, and gives what it then reads.
    pub fn set_control(&self, id: u32, value: i64) -> io::Result<i64> {
        let mut query = c::v4l2_queryctrl::zeroed();
        query.id = id;
        ioctl(&self.fd, vidioc::VIDIOC_QUERYCTRL, &mut query)?;
        if query.flags & c::V4L2_CTRL_FLAG_DISABLED != 0 || query.minimum > query.maximum {
            return Err(io::ErrorKind::Unsupported.into());
        }
        let value = value.clamp(i64::from(query.minimum), i64::from(query.maximum)) as i32;
        let mut control = c::v4l2_control { id, value };
        ioctl(&self.fd, vidioc::VIDIOC_S_CTRL, &mut control)?;
        ioctl(&self.fd, vidioc::VIDIOC_G_CTRL, &mut control)?;
        Ok(i64::from(control.value))
    }

    /// Maps up to `count` buffers, queues them and starts the stream.
    pub fn start(self, count: u32) -> io::Result<Stream> {
        let mut request = c::v4l2_requestbuffers::zeroed();
        request.count = count;
        request.type_ = self.buffer_type();
        request.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        ioctl(&self.fd, vidioc::VIDIOC_REQBUFS, &mut request)?;
        let mut stream = Stream {
            buffers: Vec::new(),
            node: self,
            broken: None,
        };
        for index in 0..request.count {
            let buffer = Mapping::new(&stream.node, index)?;
            stream.buffers.push(buffer);
            stream.queue(index)?;
        }
        let mut kind = stream.node.buffer_type() as i32;
        ioctl(&stream.node.fd, vidioc::VIDIOC_STREAMON, &mut kind)?;
        Ok(stream)
    }
}

/// A running stream. Dropping it stops it, unmaps its buffers and closes the node; a device that is gone
/// refuses all of that, which is no matter.
#[derive(Debug)]
pub struct Stream {
    // Before `node`: unmapped before the node is closed.
    buffers: Vec<Mapping>,
    node: Node,
    /// A buffer could not be given back to the driver.
    broken: Option<io::Error>,
}

impl Stream {
    /// Waits for a filled buffer or for trouble; `false` when neither came in time.
    pub fn wait(&self, patience: Duration) -> io::Result<bool> {
        let mut fd = libc::pollfd {
            fd: self.node.fd.as_raw_fd(),
            events: libc::POLLIN,
            revents: 0,
        };
        // Rounded up, lest a wait for less than a millisecond spin.
        let timeout = patience.as_micros().div_ceil(1000).min(60_000) as i32;
        // SAFETY: one live pollfd, as the count says.
        match unsafe { libc::poll(&mut fd, 1, timeout) } {
            -1 => Err(io::Error::last_os_error()),
            ready => Ok(ready > 0),
        }
    }

    /// Takes the next filled buffer, shows it to `look` and gives it back to the driver. `None` when there is
    /// none.
    pub fn next<T>(&mut self, look: impl FnOnce(&[u8], &Meta) -> T) -> io::Result<Option<T>> {
        if let Some(error) = self.broken.take() {
            return Err(error);
        }
        let (mut raw, mut plane) = self.describe(0);
        match self.buffer_ioctl(vidioc::VIDIOC_DQBUF, &mut raw, &mut plane) {
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            other => other?,
        }
        let Some(buffer) = self.buffers.get(raw.index as usize) else {
            return Err(io::Error::other(format!(
                "the driver gave buffer {}, which it does not have",
                raw.index
            )));
        };
        let (used, offset) = match self.node.capability.multi_planar {
            false => (raw.bytesused as usize, 0),
            true => (plane.bytesused as usize, plane.data_offset as usize),
        };
        let meta = Meta {
            flags: raw.flags,
            sequence: raw.sequence,
            timestamp: Duration::new(
                raw.timestamp.tv_sec.max(0) as u64,
                raw.timestamp.tv_usec.clamp(0, 999_999) as u32 * 1000,
            ),
        };
        let filled = buffer.bytes();
        let image = filled.get(offset..used.min(filled.len())).unwrap_or_default();
        let seen = look(image, &meta);
        self.broken = self.queue(raw.index).err();
        Ok(Some(seen))
    }

    fn describe(&self, index: u32) -> (c::v4l2_buffer, c::v4l2_plane) {
        let mut raw = c::v4l2_buffer::zeroed();
        raw.index = index;
        raw.type_ = self.node.buffer_type();
        raw.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        (raw, c::v4l2_plane::zeroed())
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        let (mut raw, mut plane) = self.describe(index);
        self.buffer_ioctl(vidioc::VIDIOC_QBUF, &mut raw, &mut plane)
    }

    fn buffer_ioctl(
        &self,
        request: vidioc::_IOC_TYPE,
        raw: &mut c::v4l2_buffer,
        plane: &mut c::v4l2_plane,
    ) -> io::Result<()> {
        buffer_ioctl(&self.node, request, raw, plane)
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        let mut kind = self.node.buffer_type() as i32;
        let _ = ioctl(&self.node.fd, vidioc::VIDIOC_STREAMOFF, &mut kind);
    }
}

fn buffer_ioctl(
    node: &Node,
    request: vidioc::_IOC_TYPE,
    raw: &mut c::v4l2_buffer,
    plane: &mut c::v4l2_plane,
) -> io::Result<()> {
    if node.capability.multi_planar {
        raw.m.planes = plane;
        raw.length = 1;
    }
    ioctl(&node.fd, request, raw)
}

/// One of the driver's buffers in our address space.
#[derive(Debug)]
struct Mapping {
    start: NonNull<c_void>,
    length: usize,
}

// SAFETY: a mapping belongs to the process, not to a thread, and `Mapping` is its only owner.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(node: &Node, index: u32) -> io::Result<Self> {
        let mut raw = c::v4l2_buffer::zeroed();
        let mut plane = c::v4l2_plane::zeroed();
        raw.index = index;
        raw.type_ = node.buffer_type();
        raw.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        buffer_ioctl(node, vidioc::VIDIOC_QUERYBUF, &mut raw, &mut plane)?;
        let (length, offset) = match node.capability.multi_planar {
            // SAFETY: for mapped buffers the kernel fills the offset members.
            false => (raw.length, unsafe { raw.m.offset }),
            true => (plane.length, unsafe { plane.m.mem_offset }),
        };
        let (length, offset) = (length as usize, offset.into());
        // SAFETY: asks for a fresh mapping at an address of the kernel's choice; no memory of ours is touched.
        let start = unsafe {
            v4l2::mmap(
                std::ptr::null_mut(),
                length,
                libc::PROT_READ,
                libc::MAP_SHARED,
                node.fd.as_raw_fd(),
                offset,
            )?
        };
        let start = NonNull::new(start).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { start, length })
    }

    /// The buffer's bytes; to be looked at between its dequeue and its next queue only.
    fn bytes(&self) -> &[u8] {
        // SAFETY: `start` is a live readable mapping of `length` bytes until drop, and the driver writes to it
        // only while it is queued, which `Stream::next` rules out for as long as the borrow lives.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr().cast(), self.length) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: unmaps exactly what `new` mapped; nothing can still borrow it.
        let _ = unsafe { v4l2::munmap(self.start.as_ptr(), self.length) };
    }
}

/// `argument` must be the struct that `request` is defined for: every call in this file pairs them as the V4L2
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
