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
    /// Planes of each buffer: start and length.
    buffers: Vec<Vec<(NonNull<u8>, usize)>>,
    queued: u32,
    multi_planar: bool,
}

type Planes = [c::v4l2_plane; 8];

impl Output {
    /// The node must have been given its format.
    pub fn open(path: &str, multi_planar: bool) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(path)?;
        let mut output = Self {
            file,
            buffers: Vec::new(),
            queued: 0,
            multi_planar,
        };
        // SAFETY: all zeroes is a value of this struct of integers.
        let mut request: c::v4l2_requestbuffers = unsafe { std::mem::zeroed() };
        request.count = BUFFERS;
        request.type_ = output.kind();
        request.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        output.ioctl(vidioc::VIDIOC_REQBUFS, &mut request)?;
        for index in 0..request.count {
            let mut planes = no_planes();
            let mut buffer = output.describe(index, &mut planes);
            output.ioctl(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
            let found: Vec<(u32, u32)> = match multi_planar {
                // SAFETY: what QUERYBUF filled for mapped buffers.
                false => vec![(buffer.length, unsafe { buffer.m.offset })],
                true => planes[..buffer.length as usize]
                    .iter()
                    // SAFETY: as above.
                    .map(|plane| (plane.length, unsafe { plane.m.mem_offset }))
                    .collect(),
            };
            let mut mapped = Vec::new();
            for (length, offset) in found {
                // SAFETY: a fresh mapping at the kernel's choice; the offset is what QUERYBUF filled. Unmapped on drop.
                let start = unsafe {
                    v4l2::mmap(
                        std::ptr::null_mut(),
                        length as usize,
                        libc::PROT_READ | libc::PROT_WRITE,
                        libc::MAP_SHARED,
                        output.file.as_raw_fd(),
                        offset.into(),
                    )?
                };
                let start = NonNull::new(start.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
                mapped.push((start, length as usize));
            }
            output.buffers.push(mapped);
        }
        Ok(output)
    }

    fn kind(&self) -> u32 {
        match self.multi_planar {
            false => c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT,
            true => c::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT_MPLANE,
        }
    }

    /// Shows an image: the bytes of each of its planes.
    pub fn show(&mut self, image: &[Vec<u8>]) -> io::Result<()> {
        let mut planes = no_planes();
        let index = match self.queued {
            n if n < self.buffers.len() as u32 => n,
            _ => {
                let mut buffer = self.describe(0, &mut planes);
                self.ioctl(vidioc::VIDIOC_DQBUF, &mut buffer)?;
                buffer.index
            }
        };
        let mut planes = no_planes();
        let mut buffer = self.describe(index, &mut planes);
        let mapped = &self.buffers[index as usize];
        assert_eq!(image.len(), mapped.len(), "planes");
        for (k, (bytes, (start, length))) in image.iter().zip(mapped).enumerate() {
            assert!(bytes.len() <= *length, "{} bytes into a plane of {length}", bytes.len());
            // SAFETY: the buffer is ours while it is not queued, and long enough.
            unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), start.as_ptr(), bytes.len()) };
            planes[k].bytesused = bytes.len() as u32;
        }
        buffer.bytesused = image[0].len() as u32;
        buffer.field = c::v4l2_field_V4L2_FIELD_NONE;
        self.ioctl(vidioc::VIDIOC_QBUF, &mut buffer)?;
        self.queued += 1;
        if self.queued == 1 {
            let mut kind = self.kind() as i32;
            self.ioctl(vidioc::VIDIOC_STREAMON, &mut kind)?;
        }
        Ok(())
    }

    /// A buffer; in the multi-planar interface it points to `planes`, which must outlive its use.
    fn describe(&self, index: u32, planes: &mut Planes) -> c::v4l2_buffer {
        // SAFETY: all zeroes is a value of this struct of integers.
        let mut buffer: c::v4l2_buffer = unsafe { std::mem::zeroed() };
        buffer.index = index;
        buffer.type_ = self.kind();
        buffer.memory = c::v4l2_memory_V4L2_MEMORY_MMAP;
        if self.multi_planar {
            buffer.m.planes = planes.as_mut_ptr();
            buffer.length = planes.len() as u32;
        }
        buffer
    }

    fn ioctl<T>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        // SAFETY: every call above passes the struct that the request is defined for.
        unsafe { v4l2::ioctl(self.file.as_raw_fd(), request, std::ptr::from_mut(argument).cast()) }
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        // A mapping keeps the node open.
        for (start, length) in self.buffers.drain(..).flatten() {
            // SAFETY: unmaps what `open` mapped; nothing else holds it.
            let _ = unsafe { v4l2::munmap(start.as_ptr().cast(), length) };
        }
    }
}

fn no_planes() -> Planes {
    // SAFETY: all zeroes is a value of these structs of integers.
    unsafe { std::mem::zeroed() }
}
