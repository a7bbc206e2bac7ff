//! Images of every layout, decoded by hand.

use ndarray::array;

use super::*;
use crate::frames::v4l2::Transfer;

fn granted(format: PixelFormat, width: usize, height: usize, stride: usize) -> Granted {
    Granted {
        format,
        width,
        height,
        stride,
    }
}

fn whole(shape: (usize, usize)) -> Decoding {
    Decoding {
        shape,
        ..Decoding::default()
    }
}

fn counts(granted: Granted, decoding: &Decoding, image: &[u8]) -> Counts {
    Layout::new(granted, decoding).unwrap().decode(image).unwrap()
}

#[test]
fn a_padded_image_s_region_is_binned_exactly() {
    // 5 × 4 pixels, rows of 7 bytes; the padding must never be read as light.
    let mut image = [250u8; 28];
    for y in 0..4 {
        for x in 0..5 {
            image[7 * y + x] = (10 * y + x) as u8;
        }
    }
    let region = Some(Region {
        x: 1,
        y: 2,
        width: 4,
        height: 2,
    });
    let decoding = Decoding {
        region,
        ..whole((1, 2))
    };
    let layout = Layout::new(granted(PixelFormat::GREY, 5, 4, 7), &decoding).unwrap();
    let darker = Decoding { black: 2.5, ..decoding };
    let darker = counts(granted(PixelFormat::GREY, 5, 4, 7), &darker, &image).counts;
    assert_eq!(layout.decode(&image).unwrap().counts - darker, array![[10.0, 10.0]]);
    assert_eq!(layout.binned(), 4);
    let expected = array![[21.0 + 22.0 + 31.0 + 32.0, 23.0 + 24.0 + 33.0 + 34.0]];
    assert_eq!(layout.decode(&image).unwrap().counts, expected);
    assert_eq!(layout.bytes_needed(), 3 * 7 + 5);
    let short = DecodeError::Short { found: 25, needed: 26 };
    assert_eq!(layout.decode(&image[..25]), Err(short));
    assert!(layout.decode(&image[..26]).is_ok());
}

#[test]
fn flips_mirror_the_array() {
    let granted = granted(PixelFormat::GREY, 2, 2, 2);
    let flipped = |flip| {
        let decoding = Decoding { flip, ..whole((2, 2)) };
        counts(granted, &decoding, &[1, 2, 3, 4]).counts
    };
    assert_eq!(flipped([true, false]), array![[2.0, 1.0], [4.0, 3.0]]);
    assert_eq!(flipped([false, true]), array![[3.0, 4.0], [1.0, 2.0]]);
}

#[test]
fn one_saturated_camera_pixel_saturates_its_array_pixel() {
    let layout = Layout::new(granted(PixelFormat::GREY, 4, 1, 4), &whole((1, 2))).unwrap();
    let Counts {
        mut counts, saturated, ..
    } = layout.decode(&[255, 0, 100, 101]).unwrap();
    assert_eq!(saturated, Some(array![[true, false]]));
    let masked = to_joules(&mut counts.clone(), saturated.clone(), 0.5, None);
    assert_eq!(masked, Some(array![[true, false]]));
    assert_eq!(to_joules(&mut counts, saturated, 0.5, Some(1000.0)), None);
    assert_eq!(counts, array![[1000.0, 100.5]]);
}

#[test]
fn colours_of_a_bayer_filter_are_summed_or_kept_apart() {
    let image = [10, 200, 11, 201, 200, 90, 201, 91];
    let bayer = granted(PixelFormat::RGGB, 4, 2, 4);
    assert_eq!(counts(bayer, &whole((1, 2)), &image).counts, array![[500.0, 504.0]]);
    let split = Layout::new(bayer, &whole((2, 4))).unwrap_err();
    assert_eq!(split, LayoutError::SplitsBayer { bin_x: 1, bin_y: 1 });
    let sites = Decoding {
        bayer: Bayer::Sites,
        ..whole((2, 4))
    };
    assert_eq!(counts(bayer, &sites, &image).counts[[1, 3]], 91.0);
}

#[test]
fn a_video_signal_is_linear_in_light_before_it_is_summed() {
    let response = Response {
        transfer: Transfer::Bt709,
        limited_range: true,
    };
    let decoding = Decoding {
        response,
        ..whole((1, 1))
    };
    // Black and white of YUYV, which the average of the signals would not show.
    let found = counts(granted(PixelFormat::YUYV, 2, 1, 4), &decoding, &[16, 128, 235, 128]);
    assert!((found.counts[[0, 0]] - 255.0).abs() < 1e-9);
    assert_eq!(found.saturated, Some(array![[true]]), "235 is white");
}

#[test]
fn what_does_not_fit_is_refused() {
    let image = granted(PixelFormat::Y16, 640, 480, 1280);
    let region = |x, y, width, height| Some(Region { x, y, width, height });
    let layout = |region, shape| Layout::new(image, &Decoding { region, ..whole(shape) });
    assert!(layout(region(96, 16, 448, 448), (64, 64)).is_ok());
    assert!(matches!(
        layout(None, (64, 64)),
        Err(LayoutError::NotDivisible { height: 480, .. })
    ));
    assert!(matches!(
        layout(region(0, 0, 0, 0), (64, 64)),
        Err(LayoutError::NotDivisible { .. })
    ));
    for outside in [region(200, 0, 448, 448), region(usize::MAX, 0, 64, 64)] {
        assert!(matches!(
            layout(outside, (64, 64)),
            Err(LayoutError::OutsideImage { .. })
        ));
    }
    let short_rows = granted(PixelFormat::Y16, 640, 480, 640);
    assert!(matches!(
        Layout::new(short_rows, &whole((60, 64))),
        Err(LayoutError::Stride { needed: 1280, .. })
    ));
}
