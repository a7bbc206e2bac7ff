//! Decoding of device images: whatever the driver grants and delivers, an array of the configured shape or none.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::frames::v4l2::{Granted, Layout, PixelFormat, Region};

fuzz_target!(|input: ([u16; 9], [bool; 3], u8, &[u8])| {
    let ([width, height, stride, x, y, w, h, nx, ny], [flip_x, flip_y, whole], format, image) = input;
    let formats = [PixelFormat::GREY, PixelFormat::Y10, PixelFormat::Y12];
    let granted = Granted {
        format: formats[usize::from(format) % 3],
        width: width.into(),
        height: height.into(),
        stride: stride.into(),
    };
    let region = Region {
        x: x.into(),
        y: y.into(),
        width: w.into(),
        height: h.into(),
    };
    let shape = (usize::from(ny % 64) + 1, usize::from(nx % 64) + 1);
    let Ok(layout) = Layout::new(granted, (!whole).then_some(region), shape, [flip_x, flip_y], None) else {
        return;
    };
    match layout.decode(image) {
        Some((counts, saturated)) => {
            assert_eq!(counts.dim(), shape);
            assert!(counts.iter().all(|c| *c >= 0.0 && c.is_finite()));
            assert!(saturated.is_none_or(|s| s.dim() == shape));
        }
        None => assert!(image.len() < layout.bytes_needed()),
    }
});
