//! The spot's shape, the noise and the pixels, learned from frames whose positions nobody knows, good ones and bad ones.

mod frames;
mod lenses;

use std::path::Path;
use std::process::Output;

use oapwatch::study::device;

fn oapwatch(args: &[&dyn AsRef<std::ffi::OsStr>]) -> Output {
    device::run(Path::new(env!("CARGO_BIN_EXE_oapwatch")), args)
}

/// Frames of a scene, and a config that takes its spots for Gaussians: `frames.npy` and `device.toml` in `dir`.
fn scene_frames(dir: &Path, optics: &str, emitters: &str, effects: &str, frames: usize) {
    let at = |name: &str| dir.join(name);
    let optics = format!("[optics]\npixels = [48, 48]\nsensor_size_m = [0.0225, 0.0225]\n{optics}\n");
    let scene = format!(
        "{optics}\n[link]\nintegration_time_s = 0.1\n\n{emitters}\n\n[effects]\nthermal_noise = {{}}\n{effects}\n"
    );
    std::fs::write(at("scene.toml"), scene).unwrap();
    std::fs::write(at("device.toml"), optics).unwrap();
    let made = oapwatch(&[
        &"simulate",
        &"--scene",
        &at("scene.toml"),
        &"--frames",
        &frames.to_string(),
        &"--seed",
        &"3",
        &"--out",
        &dir,
    ]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

fn learned(dir: &Path) -> Output {
    let at = |name: &str| dir.join(name);
    oapwatch(&[
        &"calibrate",
        &"--config",
        &at("device.toml"),
        &"--out",
        &at("calibration.toml"),
        &"--picture",
        &at("spot.svg"),
        &"--json",
        &at("frames.npy"),
    ])
}

/// Six beams anywhere in view, some of them overlapping.
const SIX: &str = "[random_emitters]\ncount = [6, 6]\narea_m = [170.0, 170.0]";
