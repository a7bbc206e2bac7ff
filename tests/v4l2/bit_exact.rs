//! Frames of our own simulator through the kernel: what the source gives is what was fed, bit for bit.

use metrics_exporter_prometheus::PrometheusHandle;
use ndarray::Array2;
use oapwatch::frames::v4l2::PixelFormat;
use oapwatch::scene::{Plan, Scene};

use crate::output::Output;
use crate::{CAPTURE, OUTPUT, Outcome, allow, camera, frame, source, start, v4l2_ctl, wait_for};

pub const SCENARIOS: &[(&str, fn(&PrometheusHandle) -> Outcome)] = &[
    ("bit-exact GREY", |_| round_trip(PixelFormat::GREY, false)),
    ("bit-exact Y10", |_| round_trip(PixelFormat::Y10, false)),
    ("bit-exact Y12", |_| round_trip(PixelFormat::Y12, false)),
    ("bit-exact Y16", |_| round_trip(PixelFormat::Y16, false)),
    ("bit-exact Y16_BE", |_| round_trip(PixelFormat::Y16Be, false)),
    ("bit-exact Y16 binned 7 × 7", |_| round_trip(PixelFormat::Y16, true)),
];

pub const WIDTH: usize = 640;
pub const HEIGHT: usize = 480;
const ARRAY: usize = 64;
const FRAMES: u64 = 12;

/// Joins both nodes in a loop of 640 × 480 pixels.
pub fn join(format: PixelFormat) -> Outcome {
    allow(true)?;
    let name = match format {
        PixelFormat::GREY => "GREY",
        PixelFormat::Y10 => "Y10 ",
        PixelFormat::Y12 => "Y12 ",
        PixelFormat::Y16 => "Y16 ",
        PixelFormat::Y16Be => "Y16 -BE",
    };
    v4l2_ctl(CAPTURE, &["--set-dv-bt-timings", "index=0"])?;
    v4l2_ctl(OUTPUT, &["--set-dv-bt-timings", "index=0"])?;
    v4l2_ctl(CAPTURE, &["-c", "loop_video=1,osd_text_mode=2"])?;
    let format = format!("width={WIDTH},height={HEIGHT},pixelformat={name},field=none");
    v4l2_ctl(OUTPUT, &["--set-fmt-video-out", &format])
}

/// Camera pixels a side that make one pixel of the array.
pub fn block(binned: bool) -> usize {
    if binned { 7 } else { 1 }
}

/// [x, y] of the region that holds the array.
pub fn corner(binned: bool) -> [usize; 2] {
    if binned { [96, 16] } else { [32, 48] }
}

/// A camera image whose region holds the array's counts, each spread over its block; the rest is bright, so that
/// a region off by a pixel shows.
pub fn image(counts: &Array2<u64>, format: PixelFormat, binned: bool) -> Vec<u8> {
    let (block, [x0, y0]) = (block(binned), corner(binned));
    let area = (block * block) as u64;
    let mut pixels = Array2::from_elem((HEIGHT, WIDTH), format.full_scale() - 1);
    for ((y, x), count) in counts.indexed_iter() {
        for k in 0..block * block {
            let share = count / area + u64::from((k as u64) < count % area);
            pixels[[y0 + y * block + k / block, x0 + x * block + k % block]] = share as u16;
        }
    }
    match format {
        PixelFormat::GREY => pixels.iter().map(|p| *p as u8).collect(),
        PixelFormat::Y16Be => pixels.iter().flat_map(|p| p.to_be_bytes()).collect(),
        _ => pixels.iter().flat_map(|p| p.to_le_bytes()).collect(),
    }
}

/// The array's counts for a frame in joules: `joules_per_count` is chosen for the brightest to stay unsaturated.
pub fn quantised(pixels: &Array2<f64>, joules_per_count: f64, format: PixelFormat, binned: bool) -> Array2<u64> {
    let most = (f64::from(format.full_scale()) - 1.0) * block(binned).pow(2) as f64;
    pixels.mapv(|j| (j / joules_per_count).round().clamp(0.0, most) as u64)
}

fn round_trip(format: PixelFormat, binned: bool) -> Outcome {
    join(format)?;
    let plan = Plan::compile(&Scene::builtin(), 7)?;
    let made: Vec<Array2<f64>> = (0..FRAMES).map(|k| plan.frame(k).frame.pixels).collect();
    let brightest = made.iter().flatten().fold(0.0, |a: f64, b| a.max(*b));
    let joules_per_count = brightest / (0.9 * f64::from(format.full_scale()) * block(binned).pow(2) as f64);
    let counts: Vec<_> = made
        .iter()
        .map(|pixels| quantised(pixels, joules_per_count, format, binned))
        .collect();

    let side = ARRAY * block(binned);
    let [x, y] = corner(binned);
    let config = source(|v4l2| {
        v4l2.pixel_format = Some(format);
        v4l2.roi = Some([x, y, side, side]);
    });
    let mut output = Output::open(OUTPUT)?;
    output.show(&image(&counts[0], format, binned))?;
    let capture = start(&config, &camera([ARRAY, ARRAY], joules_per_count))?;
    for k in 0..counts.len() {
        output.show(&image(&counts[k], format, binned))?;
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
