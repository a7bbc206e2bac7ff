//! A running stream: mapped buffers, dequeue and requeue.

use std::io;
use std::os::fd::AsRawFd;
use std::os::raw::c_void;
use std::ptr::NonNull;
use std::time::Duration;

use v4l::v4l_sys as c;
use v4l::v4l2::{self, vidioc};

use super::call::{Zeroed, ioctl};
use super::node::{MOST_PLANES, Node};

type Planes = [c::v4l2_plane; MOST_PLANES];

/// Metadata of one filled buffer.
#[derive(Clone, Copy, Debug)]
pub struct Meta {
    pub flags: u32,
    pub sequence: u32,
    /// On the clock that `flags` names.
    pub timestamp: Duration,
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
    /// Maps up to `count` of the node's buffers, queues them and starts the stream.
    pub fn start(node: Node, count: u32) -> io::Result<Self> {
        let mut request = c::v4l2_requestbuffers::zeroed();
        request.count = count;
        request.type_ = node.buffer_type();
        request.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        ioctl(&node.fd, vidioc::VIDIOC_REQBUFS, &mut request)?;
        let mut stream = Self {
            buffers: Vec::new(),
            node,
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

    pub fn node(&self) -> &Node {
        &self.node
    }

    /// Waits for a filled buffer or an error; `false` when neither came in time.
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
        let (mut raw, mut planes) = self.describe(0);
        match self.buffer_ioctl(vidioc::VIDIOC_DQBUF, &mut raw, &mut planes) {
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
            true => (planes[0].bytesused as usize, planes[0].data_offset as usize),
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

    fn describe(&self, index: u32) -> (c::v4l2_buffer, Planes) {
        let mut raw = c::v4l2_buffer::zeroed();
        raw.index = index;
        raw.type_ = self.node.buffer_type();
        raw.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        (raw, Planes::zeroed())
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        let (mut raw, mut planes) = self.describe(index);
        self.buffer_ioctl(vidioc::VIDIOC_QBUF, &mut raw, &mut planes)
    }

    fn buffer_ioctl(
        &self,
        request: vidioc::_IOC_TYPE,
        raw: &mut c::v4l2_buffer,
        planes: &mut Planes,
    ) -> io::Result<()> {
        buffer_ioctl(&self.node, request, raw, planes)
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
    planes: &mut Planes,
) -> io::Result<()> {
    if node.capability.multi_planar {
        raw.m.planes = planes.as_mut_ptr();
        raw.length = MOST_PLANES as u32;
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
        let mut planes = Planes::zeroed();
        raw.index = index;
        raw.type_ = node.buffer_type();
        raw.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        buffer_ioctl(node, vidioc::VIDIOC_QUERYBUF, &mut raw, &mut planes)?;
        let (length, offset) = match node.capability.multi_planar {
            // SAFETY: for mapped buffers the kernel fills the offset members.
            false => (raw.length, unsafe { raw.m.offset }),
            true => (planes[0].length, unsafe { planes[0].m.mem_offset }),
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
