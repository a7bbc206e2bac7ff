//! Frames that teach nothing, or something wrong.

use std::path::Path;
use std::process::Output;

use ndarray::Array2;
use oapwatch::frames::npy::Writer;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::{SIX, learned, scene_frames};

#[test]
fn frames_that_teach_nothing_are_refused() {
    let still = "[[user]]\nname = \"u-1\"\nmotion.still = [20, -30]";
    let weak = "[[user]]\nname = \"u-1\"\npower_w = 1e-5\nmotion.still = [20, -30]";
    for (emitters, frames, expected) in [
        (still, 100, "sixteenths of a pixel"),
        (weak, 70, "no spots in 70 frames"),
        (SIX, 10, "expected at least 15 frames, found 10"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        scene_frames(dir.path(), "spot_sigma_m = 7.5e-4", emitters, "", frames);
        let out = learned(dir.path());
        let text = String::from_utf8_lossy(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{text}");
        assert!(text.contains(expected), "{text}");
        assert!(!dir.path().join("calibration.toml").exists());
    }
}

const PIXELS: usize = 48;
const PITCH_M: f64 = 0.0225 / PIXELS as f64;
const SIGMA_M: f64 = 7.5e-4;
const NOISE_J: f64 = 1e-6;
/// Energy of a Gaussian whose brightest pixel is about 100 σ.
const ENERGY_J: f64 = 1.6e-3;

struct Beam {
    at: [f64; 2],
    energy_j: f64,
    sigma_m: f64,
}

/// `count` beams anywhere in view.
fn beams(count: usize, rng: &mut ChaCha8Rng) -> Vec<Beam> {
    let one = |_| Beam {
        at: [0; 2].map(|_| rng.random_range(-9e-3..9e-3)),
        energy_j: ENERGY_J * rng.random_range(0.5..1.5),
        sigma_m: SIGMA_M,
    };
    (0..count).map(one).collect()
}

/// A frame of Gaussian spots with noise.
fn picture(beams: &[Beam], rng: &mut ChaCha8Rng) -> Array2<f64> {
    let edge = |k: usize| (k as f64 - 0.5 * PIXELS as f64) * PITCH_M;
    let share = |k: usize, at: f64, sigma: f64| {
        let below = |x: f64| 0.5 * (1.0 + libm::erf((x - at) / (sigma * std::f64::consts::SQRT_2)));
        below(edge(k + 1)) - below(edge(k))
    };
    let noise = Normal::new(0.0, NOISE_J).unwrap();
    Array2::from_shape_fn((PIXELS, PIXELS), |(j, i)| {
        let light = |b: &Beam| b.energy_j * share(i, b.at[0], b.sigma_m) * share(j, b.at[1], b.sigma_m);
        beams.iter().map(light).sum::<f64>() + noise.sample(rng)
    })
}

/// Calibrates from sixty frames that are made one by one.
fn learned_from(frame: impl FnMut(&mut ChaCha8Rng) -> Array2<f64>) -> (tempfile::TempDir, Output) {
    let dir = tempfile::tempdir().unwrap();
    let optics = format!(
        "[optics]\npixels = [{PIXELS}, {PIXELS}]\nsensor_size_m = [0.0225, 0.0225]\nspot_sigma_m = {SIGMA_M}\n"
    );
    std::fs::write(dir.path().join("device.toml"), optics).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut file = Writer::create(dir.path().join("frames.npy"), (PIXELS, PIXELS)).unwrap();
    let mut frame = frame;
    (0..60).for_each(|_| file.push(frame(&mut rng).view()).unwrap());
    file.sync().unwrap();
    let out = learned(dir.path());
    (dir, out)
}

/// Nothing is written where the config is right already, or what is written is right.
fn assert_not_misled(out: &Output) {
    let text = String::from_utf8_lossy(&out.stderr);
    assert!(matches!(out.status.code(), Some(0 | 1)), "{text}");
    let report: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    let near = |key: &str, found: &serde_json::Value, expected: f64, tolerance: f64| {
        let found = found.as_f64().unwrap();
        assert!((found / expected - 1.0).abs() < tolerance, "{key}: {found}\n{report}");
    };
    near("width", &report["spot"]["sigma_equivalent_m"], SIGMA_M, 0.01);
    near("noise", &report["noise_std_j"], NOISE_J, 0.04);
    assert!(report["spot_error"].as_f64().unwrap() < 0.01, "{report}");
    assert!(report["bad_pixels"].as_u64().unwrap() == 0, "{report}");
    assert!(report["gain_scatter"].is_null(), "{report}");
}

fn assert_refused(dir: &Path, out: &Output, expected: &str) {
    let text = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{text}");
    assert!(text.contains(expected), "{text}");
    assert!(!dir.join("calibration.toml").exists());
}

#[test]
fn hot_pixels_that_move_are_left_out() {
    let with_flashes = |count: usize| {
        learned_from(move |rng| {
            let mut frame = picture(&beams(6, rng), rng);
            for _ in 0..count {
                frame[[rng.random_range(0..PIXELS), rng.random_range(0..PIXELS)]] += 200.0 * NOISE_J;
            }
            frame
        })
    };
    assert_not_misled(&with_flashes(5).1);
    // One in every other spot.
    let (dir, out) = with_flashes(20);
    match out.status.code() {
        Some(2) => assert_refused(dir.path(), &out, "the spots are not alike"),
        _ => assert_not_misled(&out),
    }
}

#[test]
fn a_fixed_pattern_of_dark_levels_is_no_noise() {
    let normal = Normal::new(0.0, 2.0 * NOISE_J).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let dark = Array2::from_shape_simple_fn((PIXELS, PIXELS), || normal.sample(&mut rng));
    // Spots whose width the config does not know, so that there is a shape to be learned.
    let wider = 1.2 * SIGMA_M;
    let (_dir, out) = learned_from(|rng| {
        let mut beams = beams(4, rng);
        beams.iter_mut().for_each(|beam| beam.sigma_m = wider);
        picture(&beams, rng) + &dark
    });
    assert_eq!(out.status.code(), Some(0), "{}", String::from_utf8_lossy(&out.stderr));
    let report: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    let of = |found: &serde_json::Value, truth: f64| (found.as_f64().unwrap() / truth - 1.0).abs();
    assert!(of(&report["spot"]["sigma_equivalent_m"], wider) < 0.01, "{report}");
    assert!(of(&report["noise_std_j"], NOISE_J) < 0.04, "{report}");
    assert_eq!(report["spot"]["field_degree"], 0, "{report}");
    // One pixel in five hundred is farther from its neighbours than the others' scatter lets one expect.
    assert!(report["bad_pixels"].as_u64().unwrap() <= 5, "{report}");
}

#[test]
fn saturated_spots_are_left_out_or_refused() {
    let clipped = |strength: f64, level: f64| {
        learned_from(move |rng| {
            let mut beams = beams(6, rng);
            beams.iter_mut().step_by(2).for_each(|b| b.energy_j *= strength);
            picture(&beams, rng).mapv(|v| v.min(level))
        })
    };
    assert_not_misled(&clipped(4.0, 200.0 * NOISE_J).1);
    let (dir, out) = clipped(1.0, 40.0 * NOISE_J);
    assert_refused(dir.path(), &out, "hold saturated pixels, and too little else");
}

/// Noise after the saturation hides the level: flat spots are then spots that are not alike.
#[test]
fn spots_with_a_hidden_saturation_are_refused() {
    let (dir, out) = learned_from(|rng| {
        let mut beams = beams(6, rng);
        beams.iter_mut().for_each(|b| b.energy_j *= 4.0);
        let noise = Normal::new(0.0, NOISE_J).unwrap();
        picture(&beams, rng).mapv(|v| v.min(200.0 * NOISE_J) + noise.sample(rng))
    });
    assert_refused(dir.path(), &out, "the spots are not alike");
}

#[test]
fn a_second_beam_in_every_frame_does_not_mislead() {
    // Where it always is.
    let (_dir, out) = learned_from(|rng| {
        let mut beams = beams(5, rng);
        beams.push(Beam {
            at: [2e-3, 3e-3],
            energy_j: 2.0 * ENERGY_J,
            sigma_m: SIGMA_M,
        });
        picture(&beams, rng)
    });
    assert_not_misled(&out);
    // Beside one user of six, with whom it is one spot.
    for offset in [1.5, 2.5] {
        let (_dir, out) = learned_from(|rng| {
            let mut beams = beams(6, rng);
            let user = &beams[0];
            beams.push(Beam {
                at: [user.at[0] + offset * SIGMA_M, user.at[1]],
                ..*user
            });
            picture(&beams, rng)
        });
        assert_not_misled(&out);
    }
}

#[test]
fn a_second_beam_of_another_shape_does_not_mislead() {
    let (_dir, out) = learned_from(|rng| {
        let mut beams = beams(7, rng);
        beams[6].sigma_m *= 2.0;
        picture(&beams, rng)
    });
    assert_not_misled(&out);
}

#[test]
fn frames_without_a_picture_are_refused() {
    for (value, expected) in [
        (f64::NAN, "no pixel of the 60 frames has a finite value"),
        (1e-3, "not even by noise"),
    ] {
        let (dir, out) = learned_from(|_| Array2::from_elem((PIXELS, PIXELS), value));
        assert_refused(dir.path(), &out, expected);
    }
    let (dir, out) = learned_from(|rng| picture(&[], rng));
    assert_refused(dir.path(), &out, "no spots in 60 frames");
}
