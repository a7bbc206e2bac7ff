//! Bytes of one image row → samples.

use super::format::Encoding;

impl Encoding {
    /// Samples and bytes of the smallest group that is read together.
    fn group(self) -> (usize, usize) {
        match self {
            Self::Byte { step, .. } => (1, step),
            Self::Word { .. } => (1, 2),
            Self::Packed { bits: 12 } => (2, 3),
            Self::Packed { bits } => (4, bits as usize / 2),
            Self::Jpeg => (1, 1),
        }
    }

    /// Bytes that hold the first `samples` of a row.
    pub(super) fn bytes_for(self, samples: usize) -> usize {
        let (per, bytes) = self.group();
        samples.div_ceil(per).saturating_mul(bytes)
    }
}

/// Replaces `samples` by `width` samples from column `x` of a row on. The row must hold [`Encoding::bytes_for`] `x + width` bytes.
/// A JPEG image's row is that of its decoded luma, a byte each.
pub(super) fn unpack(encoding: Encoding, row: &[u8], x: usize, width: usize, samples: &mut Vec<u16>) {
    samples.clear();
    let (per, bytes) = encoding.group();
    let skipped = x % per;
    let first = x / per * bytes;
    let groups = &row[first..encoding.bytes_for(x + width)];
    match encoding {
        Encoding::Jpeg | Encoding::Byte { step: 1, .. } => samples.extend(groups.iter().map(|b| u16::from(*b))),
        Encoding::Byte { step, offset } => {
            samples.extend(groups.chunks_exact(step).map(|group| u16::from(group[offset])));
        }
        Encoding::Word { bits, big } => {
            let mask = u16::MAX >> (16 - bits);
            let read = if big { u16::from_be_bytes } else { u16::from_le_bytes };
            samples.extend(groups.as_chunks().0.iter().map(|b| read(*b) & mask));
        }
        Encoding::Packed { bits } => {
            // MIPI CSI-2, RAW10, RAW12, RAW14: low bits follow in the order of their samples, from bit 0 up.
            let low = bits - 8;
            for group in groups.chunks_exact(bytes) {
                let (high, rest) = group.split_at(per);
                let rest = rest.iter().rev().fold(0u32, |word, b| word << 8 | u32::from(*b));
                let mask = (1 << low) - 1;
                samples.extend(
                    high.iter()
                        .zip(0..)
                        .map(|(h, k)| u16::from(*h) << low | (rest >> (low * k) & mask) as u16),
                );
            }
            samples.drain(..skipped);
            samples.truncate(width);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::v4l2::PixelFormat;

    fn row(format: PixelFormat, bytes: &[u8], x: usize, width: usize) -> Vec<u16> {
        let mut samples = vec![7];
        unpack(format.encoding(), bytes, x, width, &mut samples);
        samples
    }

    #[test]
    fn every_encoding_gives_its_samples() {
        let le = [0x34, 0xf2, 0x01, 0x00];
        let cases: [(PixelFormat, &[u8], &[u16]); 9] = [
            (PixelFormat::GREY, &le[..2], &[52, 242]),
            (PixelFormat::RGGB, &le[..2], &[52, 242]),
            (PixelFormat::Y10, &le, &[564, 1]),
            (PixelFormat::RG12, &le, &[564, 1]),
            (PixelFormat::Y14, &le, &[0x3234, 1]),
            (PixelFormat::Y16, &le, &[62004, 1]),
            (PixelFormat::Y16_BE, &le, &[13554, 256]),
            (PixelFormat::YUYV, &[10, 128, 20, 130], &[10, 20]),
            (PixelFormat::UYVY, &[128, 10, 130, 20], &[10, 20]),
        ];
        for (format, bytes, expected) in cases {
            assert_eq!(row(format, bytes, 0, 2), expected, "{format:?}");
        }
    }

    /// The layouts of the kernel's documentation of Y10P, Y12P and SRGGB14P.
    #[test]
    fn packed_rows_are_read_from_any_column() {
        // Low bits 3, 2, 1, 0 of the first four samples, 0, 1, 2, 3 of the next.
        let ten = [0x80, 0x40, 0x20, 0x10, 0b00_01_10_11, 1, 2, 3, 4, 0b11_10_01_00];
        let all = [0x203, 0x102, 0x81, 0x40, 4, 9, 14, 19];
        for x in 0..8 {
            for width in 1..=8 - x {
                assert_eq!(row(PixelFormat::Y10P, &ten, x, width), all[x..x + width], "{x} {width}");
            }
        }
        assert_eq!(
            row(PixelFormat::Y12P, &[0xab, 0x12, 0xfc, 9, 8, 0x21], 0, 4),
            [0xabc, 0x12f, 0x91, 0x82]
        );
        assert_eq!(row(PixelFormat::Y12P, &[0xab, 0x12, 0xfc], 1, 1), [0x12f]);
        let low = 0x3fu32 | 0x01 << 6 | 0x20 << 12 | 0x15 << 18;
        let [a, b, c, _] = low.to_le_bytes();
        let fourteen = [0xff, 0x00, 0x01, 0x02, a, b, c];
        assert_eq!(
            row(PixelFormat::Y14P, &fourteen, 0, 4),
            [0x3fff, 0x0001, 0x0060, 0x0095]
        );
    }
}
