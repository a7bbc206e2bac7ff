//! How much error a calibration leaves.

use std::fmt::Write;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::measured::Measured;
use crate::study::device::{Device, calibrated, error_over_bound, record};

/// Frames of a device that its error is measured on.
const FRESH_FRAMES: usize = 100;
/// Largest mean squared error over the bound after a calibration.
const GOAL: f64 = 1.5;

/// Mean squared error over the bound before and after the calibration of so many devices, by noise and number of frames.
pub fn error_left(devices: u64, seed: u64) -> Measured {
    let mut text = "| noise of a pixel, µJ | frames | before | after, each device |\n|---|---|---|---|\n".to_owned();
    let mut holds = true;
    for noise_j in [5e-6, 1e-6] {
        for frames in [80, 200] {
            let ratios: Vec<_> = (seed..seed + devices)
                .map(|k| before_and_after(noise_j, frames, k))
                .collect();
            let before = ratios.iter().map(|r| r.0).sum::<f64>() / ratios.len() as f64;
            let after: Vec<String> = ratios.iter().map(|r| format!("{:.2}", r.1)).collect();
            let noise_uj = noise_j * 1e6;
            writeln!(text, "| {noise_uj} | {frames} | {before:.0} | {} |", after.join(", ")).expect("text takes all");
            holds &= ratios.iter().all(|r| r.1 < GOAL);
        }
    }
    Measured { text, holds }
}

/// A device, beams of which one in twenty is surveyed wrongly, and what `locate` makes of fresh frames.
fn before_and_after(noise_j: f64, frames: usize, seed: u64) -> (f64, f64) {
    let program = std::env::current_exe().expect("this program's path");
    let dir = std::env::temp_dir().join(format!("oapwatch-calibration-{}-{seed}", std::process::id()));
    std::fs::create_dir_all(&dir).expect("a folder to write to");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let device = Device::new(noise_j, 0.02, 0.05, 0.01, &mut rng);
    let is_wrong = |frame: usize, k: usize| (7 * frame + k).is_multiple_of(20);
    calibrated(&program, &dir, &device, frames, &mut rng, |frame, k| {
        if is_wrong(frame, k) { 30.0 } else { 0.0 }
    });
    let (fresh, scenes) = record(&dir, "fresh.npy", &device, FRESH_FRAMES, &mut rng);
    let ratio = |config: &str| error_over_bound(&program, &dir.join(config), &fresh, &device, &scenes).0;
    let found = (ratio("plain.toml"), ratio("calibrated.toml"));
    // What is left behind lies in the folder for temporary files.
    let _ = std::fs::remove_dir_all(&dir);
    found
}
