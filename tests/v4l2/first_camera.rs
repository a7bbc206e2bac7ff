//! The commands of docs/first-camera.md on the device: it is listed, set up, captured from and located in.

use std::fs;
use std::process::{Command, Stdio};

use metrics_exporter_prometheus::PrometheusHandle;
use ndarray::Array2;
use oapwatch::frames::v4l2::PixelFormat;
use serde_json::Value;

use crate::bit_exact::{HEIGHT, WIDTH, join};
use crate::output::Output;
use crate::{CAPTURE, OUTPUT, Outcome};

pub const SCENARIOS: &[(&str, fn(&PrometheusHandle) -> Outcome)] = &[("first camera", |_| first_camera())];

const FOLDER: &str = "/tmp/first-camera";
/// Column, row and peak of each beam.
const BEAMS: [(f64, f64, f64); 3] = [
    (100.0, 90.0, 30_000.0),
    (410.5, 200.3, 20_000.0),
    (250.2, 400.7, 12_000.0),
];
const SIGMA: f64 = 2.5;
const BLACK: f64 = 1000.0;
const NOISE: f64 = 60.0;
/// Images that differ by their noise, shown in turn.
const IMAGES: u64 = 8;

fn image(seed: u64) -> Vec<Vec<u8>> {
    // Knuth's linear congruential generator, its upper bits as a number from -1 to 1. Streams that begin beside each other are not
    // independent (some pixels would deviate alike in all images, as bad ones do): SplitMix64 spreads the seeds.
    let mut state = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    state = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    state = (state ^ (state >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    state ^= state >> 31;
    let mut random = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / f64::from(1u32 << 23) - 1.0
    };
    let counts = Array2::from_shape_fn((HEIGHT, WIDTH), |(row, column)| {
        let light = BEAMS.iter().map(|(x, y, peak)| {
            let r2 = (column as f64 - x).powi(2) + (row as f64 - y).powi(2);
            if r2 > 400.0 {
                0.0
            } else {
                peak * (-0.5 * r2 / (SIGMA * SIGMA)).exp()
            }
        });
        // The sum of four even variates is near enough to normal; its variance is a third of their number.
        let noise: f64 = (0..4).map(|_| random()).sum();
        (BLACK + light.sum::<f64>() + NOISE * noise * 0.75f64.sqrt()).round() as u16
    });
    vec![counts.iter().flat_map(|c| c.to_le_bytes()).collect()]
}

/// Runs a command while images are shown; gives what it prints.
fn run_while_showing(
    output: &mut Output,
    images: &[Vec<Vec<u8>>],
    arguments: &[&str],
) -> Result<String, Box<dyn std::error::Error>> {
    let mut child = Command::new("oapwatch")
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let mut k = 0;
    while child.try_wait()?.is_none() {
        output.show(&images[k % images.len()])?;
        k += 1;
    }
    let done = child.wait_with_output()?;
    match done.status.success() {
        true => Ok(String::from_utf8(done.stdout)?),
        false => Err(format!("oapwatch {arguments:?}: {}", String::from_utf8_lossy(&done.stderr)).into()),
    }
}

fn first_camera() -> Outcome {
    join(PixelFormat::Y16)?;
    let _ = fs::remove_dir_all(FOLDER);
    fs::create_dir_all(FOLDER)?;
    let at = |name: &str| format!("{FOLDER}/{name}");
    let images: Vec<_> = (0..IMAGES).map(image).collect();
    let mut output = Output::open(OUTPUT, false)?;
    output.show(&images[0])?;
    let config = at("oapwatch.toml");
    let setup = [
        "setup",
        "--device",
        CAPTURE,
        "--altitude-m",
        "120",
        "--field-of-view-deg",
        "60",
        "--out",
        &config,
    ];
    let found = run_while_showing(&mut output, &images, &setup)?;
    for expected in ["Y16 640 × 480", "spots: 3", "bad pixels: 0", "320 × 240"] {
        if !found.contains(expected) {
            return Err(format!("{expected:?} is not in:\n{found}").into());
        }
    }
    let frames = at("frames.npy");
    let capture = ["capture", "--config", &config, "--frames", "5", "--out", &frames];
    run_while_showing(&mut output, &images, &capture)?;
    let about: toml::Table = fs::read_to_string(at("frames.toml"))?.parse()?;
    if about["times"].as_array().map(Vec::len) != Some(5) || about["device"]["pixel_format"].as_str() != Some("Y16") {
        return Err(format!("frames.toml says {about}").into());
    }
    let located = ["locate", "--config", &config, "--estimator", "greedy-fit", &frames];
    let located = run_while_showing(&mut output, &images, &located)?;
    for line in located.lines() {
        let line: Value = serde_json::from_str(line)?;
        let emitters = line["emitters"].as_array().ok_or("no emitters")?;
        for (column, row, _) in BEAMS {
            // 60° over the width, 120 m below.
            let metres = |at: f64, of: usize| (at + 0.5 - of as f64 / 2.0) * 120.0 * 30f64.to_radians().tan() / 320.0;
            let (x, y) = (metres(column, WIDTH), metres(row, HEIGHT));
            let is_near = |e: &Value| {
                let [a, b] = ["x_m", "y_m"].map(|key| e[key].as_f64().unwrap_or(f64::MAX));
                (a - x).hypot(b - y) < 0.05
            };
            if emitters.len() != BEAMS.len() || !emitters.iter().any(is_near) {
                return Err(format!("no beam at ({x:.2}, {y:.2}), or others: {line}").into());
            }
        }
    }
    Ok(())
}
