//! Feeds images into vivid's output node, one at a time.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::ptr::NonNull;

use v4l::v4l_sys as c;
use v4l::v4l2::{self, vidioc};

const BUFFERS: u32 = 4;

/// An output stream. The image last queued is shown until the next one.
pub struct Output {
    file: File,
    buffers: Vec<(NonNull<u8>, usize)>,
    queued: u32,
}

impl Output {
    /// The node must have been given its format.
    pub fn open(path: &str) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(path)?;
        let mut output = Self {
            file,
            buffers: Vec::new(),
            queued: 0,
        };
        // SAFETY: all zeroes is a value of this struct of integers.
        let mut request: c::v4l2_requestbuffers = unsafe { std::mem::zeroed() };
        request.count = BUFFERS;
        request.type_ = c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT;
        request.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        output.ioctl(vidioc::VIDIOC_REQBUFS, &mut request)?;
        for index in 0..request.count {
            let mut buffer = describe(index);
            output.ioctl(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
            // SAFETY: a fresh mapping at the kernel's choice; the offset is what QUERYBUF filled. Unmapped on drop.
            let start = unsafe {
                v4l2::mmap(
                    std::ptr::null_mut(),
                    buffer.length as usize,
                    libc::PROT_READ | libc::PROT_WRITE,
                    libc::MAP_SHARED,
                    output.file.as_raw_fd(),
                    buffer.m.offset.into(),
                )?
            };
            let start = NonNull::new(start.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
            output.buffers.push((start, buffer.length as usize));
        }
        Ok(output)
    }

    /// Shows an image.
    pub fn show(&mut self, image: &[u8]) -> io::Result<()> {
        let index = match self.queued {
            n if n < self.buffers.len() as u32 => n,
            _ => {
                let mut buffer = describe(0);
                self.ioctl(vidioc::VIDIOC_DQBUF, &mut buffer)?;
                buffer.index
            }
        };
        let (start, length) = self.buffers[index as usize];
        assert!(image.len() <= length, "{} bytes into a buffer of {length}", image.len());
        // SAFETY: the buffer is ours while it is not queued, and long enough.
        unsafe { std::ptr::copy_nonoverlapping(image.as_ptr(), start.as_ptr(), image.len()) };
        let mut buffer = describe(index);
        buffer.bytesused = image.len() as u32;
        buffer.field = c::v4l2_field_V4L2_FIELD_NONE;
        self.ioctl(vidioc::VIDIOC_QBUF, &mut buffer)?;
        self.queued += 1;
        if self.queued == 1 {
            let mut kind = c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT as i32;
            self.ioctl(vidioc::VIDIOC_STREAMON, &mut kind)?;
        }
        Ok(())
    }

    fn ioctl<T>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        // SAFETY: every call above passes the struct that the request is defined for.
        unsafe { v4l2::ioctl(self.file.as_raw_fd(), request, std::ptr::from_mut(argument).cast()) }
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        // A mapping keeps the node open.
        for (start, length) in self.buffers.drain(..) {
            // SAFETY: unmaps what `open` mapped; nothing else holds it.
            let _ = unsafe { v4l2::munmap(start.as_ptr().cast(), length) };
        }
    }
}

fn describe(index: u32) -> c::v4l2_buffer {
    // SAFETY: all zeroes is a value of this struct of integers.
    let mut buffer: c::v4l2_buffer = unsafe { std::mem::zeroed() };
    buffer.index = index;
    buffer.type_ = c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT;
    buffer.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
    buffer
}
