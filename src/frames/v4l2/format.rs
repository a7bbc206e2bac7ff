//! Pixel formats whose samples of the light can be read, and what each keeps of it.

use serde::{Deserialize, Serialize};

/// A pixel format, named by its four-character code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct PixelFormat {
    fourcc: u32,
    encoding: Encoding,
    light: Light,
}

/// How samples lie in a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    /// A byte each, `step` bytes apart, the first at `offset`.
    Byte { step: usize, offset: usize },
    /// Two bytes each; the bits above the depth are undefined.
    Word { bits: u32, big: bool },
    /// MIPI CSI-2: the high bytes of a group of samples, then their low bits.
    Packed { bits: u32 },
    /// A JPEG image a frame.
    Jpeg,
}

/// Which light a sample stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Light {
    /// All light on the pixel.
    Grey,
    /// Light behind one colour of a Bayer filter.
    Bayer,
    /// A video signal's brightness, computed from three colours and mostly on a gamma curve.
    Luma,
}

const BYTES: Encoding = Encoding::Byte { step: 1, offset: 0 };
const GREY8: PixelFormat = PixelFormat::new(*b"GREY", BYTES, Light::Grey);

const fn words(bits: u32) -> Encoding {
    Encoding::Word { bits, big: false }
}

const fn bayer(name: [u8; 4], encoding: Encoding) -> PixelFormat {
    PixelFormat::new(name, encoding, Light::Bayer)
}

const fn luma(name: [u8; 4], encoding: Encoding) -> PixelFormat {
    PixelFormat::new(name, encoding, Light::Luma)
}

impl PixelFormat {
    pub const GREY: Self = GREY8;
    pub const Y10: Self = Self::new(*b"Y10 ", words(10), Light::Grey);
    pub const Y12: Self = Self::new(*b"Y12 ", words(12), Light::Grey);
    pub const Y14: Self = Self::new(*b"Y14 ", words(14), Light::Grey);
    pub const Y16: Self = Self::new(*b"Y16 ", words(16), Light::Grey);
    /// Big-endian formats carry bit 31.
    pub const Y16_BE: Self = Self {
        fourcc: Self::Y16.fourcc | 1 << 31,
        encoding: Encoding::Word { bits: 16, big: true },
        light: Light::Grey,
    };
    pub const Y10P: Self = Self::new(*b"Y10P", Encoding::Packed { bits: 10 }, Light::Grey);
    pub const Y12P: Self = Self::new(*b"Y12P", Encoding::Packed { bits: 12 }, Light::Grey);
    pub const Y14P: Self = Self::new(*b"Y14P", Encoding::Packed { bits: 14 }, Light::Grey);
    pub const YUYV: Self = luma(*b"YUYV", Encoding::Byte { step: 2, offset: 0 });
    pub const UYVY: Self = luma(*b"UYVY", Encoding::Byte { step: 2, offset: 1 });
    pub const NV12: Self = luma(*b"NV12", BYTES);
    pub const NV16: Self = luma(*b"NV16", BYTES);
    /// NV12 and NV16 with luma in a plane of its own.
    pub const NM12: Self = luma(*b"NM12", BYTES);
    pub const NM16: Self = luma(*b"NM16", BYTES);
    pub const MJPG: Self = luma(*b"MJPG", Encoding::Jpeg);
    pub const RGGB: Self = bayer(*b"RGGB", BYTES);
    pub const RG10: Self = bayer(*b"RG10", words(10));
    pub const RG12: Self = bayer(*b"RG12", words(12));
    pub const RG16: Self = bayer(*b"RG16", words(16));

    pub const ALL: [Self; 45] = [
        Self::GREY,
        Self::Y10,
        Self::Y12,
        Self::Y14,
        Self::Y16,
        Self::Y16_BE,
        Self::Y10P,
        Self::Y12P,
        Self::Y14P,
        Self::YUYV,
        luma(*b"YVYU", Encoding::Byte { step: 2, offset: 0 }),
        Self::UYVY,
        luma(*b"VYUY", Encoding::Byte { step: 2, offset: 1 }),
        Self::NV12,
        luma(*b"NV21", BYTES),
        Self::NV16,
        luma(*b"NV61", BYTES),
        Self::NM12,
        Self::NM16,
        Self::MJPG,
        luma(*b"JPEG", Encoding::Jpeg),
        // The four orders of colours, 8 bits a sample to 16.
        bayer(*b"BA81", BYTES),
        bayer(*b"GBRG", BYTES),
        bayer(*b"GRBG", BYTES),
        Self::RGGB,
        bayer(*b"BG10", words(10)),
        bayer(*b"GB10", words(10)),
        bayer(*b"BA10", words(10)),
        Self::RG10,
        bayer(*b"pBAA", Encoding::Packed { bits: 10 }),
        bayer(*b"pGAA", Encoding::Packed { bits: 10 }),
        bayer(*b"pgAA", Encoding::Packed { bits: 10 }),
        bayer(*b"pRAA", Encoding::Packed { bits: 10 }),
        bayer(*b"BG12", words(12)),
        bayer(*b"GB12", words(12)),
        bayer(*b"BA12", words(12)),
        Self::RG12,
        bayer(*b"pBCC", Encoding::Packed { bits: 12 }),
        bayer(*b"pGCC", Encoding::Packed { bits: 12 }),
        bayer(*b"pgCC", Encoding::Packed { bits: 12 }),
        bayer(*b"pRCC", Encoding::Packed { bits: 12 }),
        bayer(*b"BYR2", words(16)),
        bayer(*b"GB16", words(16)),
        bayer(*b"GR16", words(16)),
        Self::RG16,
    ];

    const fn new(name: [u8; 4], encoding: Encoding, light: Light) -> Self {
        Self {
            fourcc: u32::from_le_bytes(name),
            encoding,
            light,
        }
    }

    /// The kernel's code.
    pub fn fourcc(self) -> u32 {
        self.fourcc
    }

    pub fn from_fourcc(fourcc: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.fourcc == fourcc)
    }

    pub fn name(self) -> String {
        fourcc_name(self.fourcc)
    }

    pub(super) fn encoding(self) -> Encoding {
        self.encoding
    }

    pub fn light(self) -> Light {
        self.light
    }

    pub fn is_compressed(self) -> bool {
        self.encoding == Encoding::Jpeg
    }

    pub fn bits(self) -> u32 {
        match self.encoding {
            Encoding::Byte { .. } | Encoding::Jpeg => 8,
            Encoding::Word { bits, .. } | Encoding::Packed { bits } => bits,
        }
    }

    /// The largest count a sample can hold.
    pub fn full_scale(self) -> u16 {
        u16::MAX >> (16 - self.bits())
    }

    /// What the format keeps of the light and what it costs, for a reader who chooses.
    pub fn says(self) -> String {
        let bits = self.bits();
        match (self.encoding, self.light) {
            (Encoding::Jpeg, _) => {
                "8 bits, compressed: blocks of 8 × 8 are rounded in frequency, faint spots with them".to_owned()
            }
            (_, Light::Grey) => format!("{bits} bits, all light on every pixel"),
            (_, Light::Bayer) => format!("{bits} bits, each pixel behind one colour of a filter"),
            (_, Light::Luma) => {
                format!("{bits} bits of a video signal's brightness, mostly on a gamma curve; colour is dropped")
            }
        }
    }
}

impl From<PixelFormat> for String {
    fn from(format: PixelFormat) -> Self {
        format.name()
    }
}

impl TryFrom<String> for PixelFormat {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        Self::ALL.into_iter().find(|f| f.name() == name).ok_or_else(|| {
            let known: Vec<String> = Self::ALL.into_iter().map(Self::name).collect();
            format!("expected a pixel format, one of {}; found {name:?}", known.join(", "))
        })
    }
}

/// A four-character code as text.
pub fn fourcc_name(fourcc: u32) -> String {
    let bytes = (fourcc & !(1 << 31)).to_le_bytes();
    let name: String = bytes
        .iter()
        .map(|b| char::from(*b))
        .filter(|c| c.is_ascii_graphic())
        .collect();
    match fourcc >> 31 {
        0 => name,
        _ => name + "_BE",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_is_found_by_its_code_and_by_its_name() {
        for format in PixelFormat::ALL {
            assert_eq!(PixelFormat::from_fourcc(format.fourcc()), Some(format));
            assert_eq!(PixelFormat::try_from(format.name()), Ok(format));
        }
        assert_eq!(PixelFormat::Y16_BE.name(), "Y16_BE");
        assert_eq!(PixelFormat::Y10.name(), "Y10");
        assert_eq!(PixelFormat::Y12P.full_scale(), 4095);
        assert!(PixelFormat::try_from("RGB3".to_owned()).unwrap_err().contains("Y16_BE"));
    }
}
