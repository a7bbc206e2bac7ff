//! Frames of our own simulator through the kernel: what the source gives is what was fed, bit for bit.

use metrics_exporter_prometheus::PrometheusHandle;
use ndarray::Array2;
use oapwatch::frames::v4l2::{Bayer, PixelFormat};
use oapwatch::scene::{Plan, Scene};

use crate::output::Output;
use crate::{CAPTURE, OUTPUT, Outcome, allow_on, camera, frame, source, start, v4l2_ctl, wait_for};

pub const SCENARIOS: &[(&str, fn(&PrometheusHandle) -> Outcome)] = &[
    ("bit-exact GREY", |_| round_trip(SINGLE, PixelFormat::GREY, 1)),
    ("bit-exact Y10", |_| round_trip(SINGLE, PixelFormat::Y10, 1)),
    ("bit-exact Y12", |_| round_trip(SINGLE, PixelFormat::Y12, 1)),
    ("bit-exact Y16", |_| round_trip(SINGLE, PixelFormat::Y16, 1)),
    ("bit-exact Y16_BE", |_| round_trip(SINGLE, PixelFormat::Y16_BE, 1)),
    ("bit-exact Y16 binned 7 × 7", |_| {
        round_trip(SINGLE, PixelFormat::Y16, 7)
    }),
    ("bit-exact YUYV", |_| round_trip(SINGLE, PixelFormat::YUYV, 1)),
    ("bit-exact UYVY", |_| round_trip(SINGLE, PixelFormat::UYVY, 1)),
    ("bit-exact NV12", |_| round_trip(SINGLE, PixelFormat::NV12, 1)),
    ("bit-exact NV16", |_| round_trip(SINGLE, PixelFormat::NV16, 1)),
    ("bit-exact Bayer 8", |_| round_trip(SINGLE, PixelFormat::RGGB, 1)),
    ("bit-exact Bayer 10", |_| round_trip(SINGLE, PixelFormat::RG10, 1)),
    ("bit-exact Bayer 12", |_| round_trip(SINGLE, PixelFormat::RG12, 1)),
    ("bit-exact Bayer 16", |_| round_trip(SINGLE, PixelFormat::RG16, 1)),
    ("bit-exact Bayer 12 binned 2 × 2", |_| {
        round_trip(SINGLE, PixelFormat::RG12, 2)
    }),
    ("bit-exact multi-planar GREY", |_| {
        round_trip(MULTI, PixelFormat::GREY, 1)
    }),
    ("bit-exact multi-planar NM12", |_| {
        round_trip(MULTI, PixelFormat::NM12, 1)
    }),
    ("bit-exact multi-planar NM16", |_| {
        round_trip(MULTI, PixelFormat::NM16, 1)
    }),
];

/// Capture and output node of a virtual camera with the single-planar interface, and of one with the multi-planar.
const SINGLE: [&str; 2] = [CAPTURE, OUTPUT];
const MULTI: [&str; 2] = ["/dev/video2", "/dev/video3"];

pub const WIDTH: usize = 640;
pub const HEIGHT: usize = 480;
const ARRAY: usize = 64;
const FRAMES: u64 = 12;

/// Joins both nodes of the first camera in a loop of 640 × 480 pixels.
pub fn join(format: PixelFormat) -> Outcome {
    join_nodes(SINGLE, format)
}

fn join_nodes([capture, output]: [&str; 2], format: PixelFormat) -> Outcome {
    allow_on(capture, true)?;
    let name = match format {
        PixelFormat::Y16_BE => "Y16 -BE".to_owned(),
        format => format!("{:4}", format.name()),
    };
    v4l2_ctl(capture, &["--set-dv-bt-timings", "index=0"])?;
    v4l2_ctl(output, &["--set-dv-bt-timings", "index=0"])?;
    v4l2_ctl(capture, &["-c", "loop_video=1,osd_text_mode=2"])?;
    let format = format!("width={WIDTH},height={HEIGHT},pixelformat={name},field=none");
    v4l2_ctl(output, &["--set-fmt-video-out", &format])
}

/// [x, y] of the region that holds the array; `block` camera pixels a side make one pixel of the array.
pub fn corner(block: usize) -> [usize; 2] {
    if block == 1 { [32, 48] } else { [96, 16] }
}

/// A camera image whose region holds the array's counts, each spread over its block; the rest is bright, so that
/// a region off by a pixel shows. Colours and planes other than the first hold what is no light.
pub fn image(counts: &Array2<u64>, format: PixelFormat, block: usize) -> Vec<Vec<u8>> {
    const COLOUR: u8 = 77;
    let [x0, y0] = corner(block);
    let area = (block * block) as u64;
    let mut pixels = Array2::from_elem((HEIGHT, WIDTH), format.full_scale() - 1);
    for ((y, x), count) in counts.indexed_iter() {
        for k in 0..block * block {
            let share = count / area + u64::from((k as u64) < count % area);
            pixels[[y0 + y * block + k / block, x0 + x * block + k % block]] = share as u16;
        }
    }
    let bytes = || pixels.iter().map(|p| *p as u8);
    let colours = |rows: usize| vec![COLOUR; WIDTH * rows];
    match format {
        PixelFormat::GREY | PixelFormat::RGGB => vec![bytes().collect()],
        PixelFormat::YUYV => vec![bytes().flat_map(|b| [b, COLOUR]).collect()],
        PixelFormat::UYVY => vec![bytes().flat_map(|b| [COLOUR, b]).collect()],
        PixelFormat::NV12 => vec![bytes().chain(colours(HEIGHT / 2)).collect()],
        PixelFormat::NV16 => vec![bytes().chain(colours(HEIGHT)).collect()],
        PixelFormat::NM12 => vec![bytes().collect(), colours(HEIGHT / 2)],
        PixelFormat::NM16 => vec![bytes().collect(), colours(HEIGHT)],
        PixelFormat::Y16_BE => vec![pixels.iter().flat_map(|p| p.to_be_bytes()).collect()],
        _ => vec![pixels.iter().flat_map(|p| p.to_le_bytes()).collect()],
    }
}

/// The array's counts for a frame in joules: `joules_per_count` is chosen for the brightest to stay unsaturated.
pub fn quantised(pixels: &Array2<f64>, joules_per_count: f64, format: PixelFormat, block: usize) -> Array2<u64> {
    let most = (f64::from(format.full_scale()) - 1.0) * block.pow(2) as f64;
    pixels.mapv(|j| (j / joules_per_count).round().clamp(0.0, most) as u64)
}

fn round_trip(nodes: [&str; 2], format: PixelFormat, block: usize) -> Outcome {
    join_nodes(nodes, format)?;
    let plan = Plan::compile(&Scene::builtin(), 7)?;
    let made: Vec<Array2<f64>> = (0..FRAMES).map(|k| plan.frame(k).frame.pixels).collect();
    let brightest = made.iter().flatten().fold(0.0, |a: f64, b| a.max(*b));
    let joules_per_count = brightest / (0.9 * f64::from(format.full_scale()) * block.pow(2) as f64);
    let counts: Vec<_> = made
        .iter()
        .map(|pixels| quantised(pixels, joules_per_count, format, block))
        .collect();

    let side = ARRAY * block;
    let [x, y] = corner(block);
    let mut config = source(|v4l2| {
        v4l2.pixel_format = Some(format);
        v4l2.roi = Some([x, y, side, side]);
        if block == 1 {
            v4l2.bayer = Bayer::Sites;
        }
    });
    config.device = Some(nodes[0].into());
    let mut output = Output::open(nodes[1], nodes == MULTI)?;
    output.show(&image(&counts[0], format, block))?;
    let capture = start(&config, &camera([ARRAY, ARRAY], joules_per_count))?;
    for k in 0..counts.len() {
        output.show(&image(&counts[k], format, block))?;
        let joules = |k: usize| counts[k].mapv(|c| c as f64) * joules_per_count;
        let (expected, before) = (joules(k), joules(k.saturating_sub(1)));
        let mut foreign = 0;
        let got = wait_for(&capture, "the frame that was fed", |next| {
            let frame = frame(next)?;
            // The loop may show a test image until the output streams, and the one before until the next tick.
            foreign += usize::from(frame.pixels != expected && frame.pixels != before && k > 0);
            (frame.pixels == expected).then_some(frame)
        })?;
        if foreign > 0 {
            return Err(format!("{foreign} frames before frame {k} were never fed").into());
        }
        if got.masked.is_some() {
            return Err(format!("frame {k} has masked pixels").into());
        }
    }
    Ok(())
}
