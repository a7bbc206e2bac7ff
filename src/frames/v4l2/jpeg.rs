//! Decodes a JPEG image's brightness. A damaged image is an error.

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

const BEGIN: [u8; 2] = [0xff, 0xd8];
const END: [u8; 2] = [0xff, 0xd9];
const HUFFMAN_TABLES: u8 = 0xc4;
const SCAN: u8 = 0xda;

/// A Huffman table as JPEG writes it: codes of each length from 1 to 16, then what they stand for.
pub struct HuffmanTable {
    /// Class (0 for differences of means, 1 for the others) and number, as in the file.
    pub id: u8,
    pub lengths: [u8; 16],
    pub values: &'static [u8],
}

/// Brightness of every pixel, row by row, of an image that must be `width` × `height`.
///
/// # Errors
/// What is wrong with the image.
pub(super) fn luma(image: &[u8], width: usize, height: usize) -> Result<Vec<u8>, String> {
    let scan =
        scan_of(image).ok_or_else(|| format!("no JPEG image: it begins with {:02x?}", &image[..image.len().min(4)]))?;
    // What a driver adds behind the end is left out.
    let end = image[scan.start..].windows(2).rposition(|mark| mark == END);
    let Some(end) = end else {
        return Err(format!("a truncated JPEG image of {} bytes", image.len()));
    };
    let image = &image[..scan.start + end + END.len()];
    let completed;
    let image = match scan.has_tables {
        true => image,
        false => {
            let (head, rest) = image.split_at(scan.start);
            completed = [head, &usual_tables(), rest].concat();
            &completed
        }
    };
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(width)
        .set_max_height(height)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(image), options);
    let fail = |error| format!("a damaged JPEG image: {error}");
    decoder.decode_headers().map_err(fail)?;
    if let Some((w, h)) = decoder.dimensions().filter(|found| *found != (width, height)) {
        return Err(format!("a JPEG image of {w} × {h} pixels, expected {width} × {height}"));
    }
    let luma = decoder.decode().map_err(fail)?;
    match luma.len() == width * height {
        true => Ok(luma),
        false => Err(format!(
            "a JPEG image of {} samples, expected {width} × {height}",
            luma.len()
        )),
    }
}

struct Scan {
    /// Where the scan's segment begins.
    start: usize,
    /// Whether Huffman tables come before it.
    has_tables: bool,
}

/// Walks the segments up to the first scan; `None` where the image has none.
fn scan_of(image: &[u8]) -> Option<Scan> {
    let mut start = image.starts_with(&BEGIN).then_some(BEGIN.len())?;
    let mut has_tables = false;
    loop {
        let [0xff, kind, high, low] = *image.get(start..start + 4)? else {
            return None;
        };
        has_tables |= kind == HUFFMAN_TABLES;
        if kind == SCAN {
            return Some(Scan { start, has_tables });
        }
        start += 2 + usize::from(u16::from_be_bytes([high, low]));
    }
}

/// The segment of the tables that cameras leave out of motion JPEG.
pub fn usual_tables() -> Vec<u8> {
    let tables: Vec<u8> = USUAL_HUFFMAN_TABLES
        .iter()
        .flat_map(|t| [&[t.id], &t.lengths[..], t.values].concat())
        .collect();
    let length = (tables.len() + 2) as u16;
    [&[0xff, HUFFMAN_TABLES], &length.to_be_bytes()[..], &tables].concat()
}

/// ITU-T T.81, tables K.3 to K.6.
pub const USUAL_HUFFMAN_TABLES: [HuffmanTable; 4] = [
    HuffmanTable {
        id: 0x00,
        lengths: [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0],
        values: &DIFFERENCES,
    },
    HuffmanTable {
        id: 0x01,
        lengths: [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0],
        values: &DIFFERENCES,
    },
    HuffmanTable {
        id: 0x10,
        lengths: [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125],
        values: &[
            0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
            0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
            0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
            0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
            0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
            0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
            0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
            0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
            0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
        ],
    },
    HuffmanTable {
        id: 0x11,
        lengths: [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119],
        values: &[
            0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
            0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
            0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
            0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
            0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
            0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
            0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
            0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
            0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
        ],
    },
];

const DIFFERENCES: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];

#[cfg(test)]
mod tests {
    use super::*;

    /// 40 × 24 pixels in colours, 4:2:2, as `cjpeg -quality 90 -sample 2x1` wrote them; made by tests/data/mjpg/make.sh.
    const IMAGE: &[u8] = include_bytes!("../../../tests/data/mjpg/colours.jpg");
    /// What `djpeg -grayscale` reads from it.
    const LUMA: &[u8] = include_bytes!("../../../tests/data/mjpg/colours.luma");

    fn differs_most(image: &[u8]) -> u8 {
        let found = luma(image, 40, 24).unwrap();
        found.iter().zip(LUMA).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
    }

    fn without_tables() -> Vec<u8> {
        let scan = scan_of(IMAGE).unwrap().start;
        let mut bare = BEGIN.to_vec();
        let mut start = BEGIN.len();
        while start < scan {
            let length = 2 + usize::from(u16::from_be_bytes([IMAGE[start + 2], IMAGE[start + 3]]));
            if IMAGE[start + 1] != HUFFMAN_TABLES {
                bare.extend(&IMAGE[start..start + length]);
            }
            start += length;
        }
        bare.extend(&IMAGE[scan..]);
        bare
    }

    #[test]
    fn brightness_is_read_as_the_reference_decoder_does() {
        // The standard lets decoders differ by one.
        assert!(differs_most(IMAGE) <= 1);
        let bare = without_tables();
        assert!(bare.len() < IMAGE.len() - 400);
        assert!(differs_most(&bare) <= 1, "motion JPEG without tables");
        assert!(differs_most(&[IMAGE, &[0; 100]].concat()) <= 1, "padded");
    }

    #[test]
    fn a_truncated_or_foreign_image_is_an_error() {
        for length in 0..IMAGE.len() {
            assert!(luma(&IMAGE[..length], 40, 24).is_err(), "{length} bytes");
        }
        let size = luma(IMAGE, 64, 24).unwrap_err();
        assert!(size.contains("40 × 24 pixels, expected 64 × 24"), "{size}");
        assert!(luma(&[7; 100], 40, 24).unwrap_err().contains("no JPEG image"));
    }
}
