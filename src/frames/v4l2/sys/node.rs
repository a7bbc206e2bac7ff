//! An open device node: capability, formats, frame interval and controls.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use v4l::v4l_sys as c;
use v4l::v4l2::vidioc;

use super::call::{Zeroed, ioctl, text};

/// VIDEO_MAX_PLANES.
pub(super) const MOST_PLANES: usize = 8;

/// Identity of a node.
#[derive(Clone, Debug)]
pub struct Capability {
    pub driver: String,
    pub card: String,
    pub bus: String,
    /// Captures video, in the single-planar or the multi-planar interface.
    pub captures: bool,
    pub streams: bool,
    pub(super) multi_planar: bool,
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

impl Sizes {
    /// The size to use: of a range `wished` where it is one of it, otherwise the largest, which a driver may make by scaling.
    pub fn choice(self, wished: [u32; 2]) -> [u32; 2] {
        match self {
            Self::One { width, height } => [width, height],
            Self::Range { min, max, step } => {
                let is_one = |k: usize| {
                    let above = wished[k].checked_sub(min[k]).filter(|_| wished[k] <= max[k]);
                    above.is_some_and(|above| above.checked_rem(step[k]).is_none_or(|r| r == 0))
                };
                if is_one(0) && is_one(1) { wished } else { max }
            }
        }
    }
}

/// An image format, as asked for or as granted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Format {
    pub fourcc: u32,
    pub width: u32,
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Bytes of a whole image, or of its first plane.
    pub size: u32,
    pub colour: Colour,
    /// Planes of a frame, each in a buffer of its own; the first holds what is read.
    pub planes: u8,
}

/// How a driver says that counts follow from light, in V4L2's numbers; 0 leaves it to the colour space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colour {
    pub space: u32,
    pub quantisation: u32,
    pub transfer: u32,
}

/// An open device node, non-blocking.
#[derive(Debug)]
pub struct Node {
    pub(super) fd: File,
    pub(super) capability: Capability,
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

    pub(super) fn buffer_type(&self) -> u32 {
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
        // Bounded: a faulty driver might never end the list with EINVAL.
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
                colour: Colour {
                    space: pix.colorspace,
                    quantisation: pix.quantization,
                    transfer: pix.xfer_func,
                },
                planes: 1,
            });
        }
        // SAFETY: as above, for the multi-planar buffer type.
        let pix = unsafe { raw.fmt.pix_mp };
        // Copied, since the struct is packed.
        let (plane, planes) = (pix.plane_fmt[0], pix.num_planes);
        if !(1..=MOST_PLANES).contains(&usize::from(planes)) {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                format!("an image of {planes} planes; V4L2 has one to {MOST_PLANES}"),
            ));
        }
        Ok(Format {
            fourcc: pix.pixelformat,
            width: pix.width,
            height: pix.height,
            stride: plane.bytesperline,
            size: plane.sizeimage,
            colour: Colour {
                space: pix.colorspace,
                quantisation: pix.quantization.into(),
                transfer: pix.xfer_func.into(),
            },
            planes,
        })
    }

    /// The highest frame rate of a format and size, Hz, where the node lists it.
    pub fn fastest_hz(&self, fourcc: u32, [width, height]: [u32; 2]) -> Option<f64> {
        let rate = |index| {
            let mut raw = c::v4l2_frmivalenum::zeroed();
            (raw.index, raw.pixel_format, raw.width, raw.height) = (index, fourcc, width, height);
            ioctl(&self.fd, vidioc::VIDIOC_ENUM_FRAMEINTERVALS, &mut raw).ok()?;
            let interval = match raw.type_ == c::v4l2_frmivaltypes_V4L2_FRMIVAL_TYPE_DISCRETE {
                // SAFETY: the type says which member the kernel filled; both are integers.
                true => unsafe { raw.__bindgen_anon_1.discrete },
                // SAFETY: as above.
                false => unsafe { raw.__bindgen_anon_1.stepwise.min },
            };
            Some(f64::from(interval.denominator) / f64::from(interval.numerator.max(1)))
        };
        (0..256).map_while(rate).max_by(f64::total_cmp)
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
}
