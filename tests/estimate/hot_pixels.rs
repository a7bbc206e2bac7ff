//! Pixels that are hot, on a sensor whose pixels are too wide for the part of a frame outside the basis to show them.

use ndarray::Array2;
use oapwatch::estimate::{Config, Rules, build};
use oapwatch::optics::{self, SpotError, add_spot};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::frames::{estimator, frame};
use crate::lens::{FIVE, SIGMA_M, camera_of, moffat, render_density};

#[test]
fn a_hot_pixel_is_no_emitter_where_pixels_are_wide() {
    let config = optics::Config {
        pixels: [40, 40],
        spot_sigma_m: Some(1e-3),
        ..optics::Config::default()
    };
    let camera = config.camera().unwrap();
    let mut estimator = estimator(None, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(36);
    let noise = Normal::new(0.0, camera.noise_std_j).unwrap();
    for _ in 0..40 {
        let mut pixels = vec![0.0; 40 * 40];
        // An SNR of fifty.
        FIVE.iter()
            .for_each(|at| add_spot(&camera, *at, 560.0 * camera.noise_std_j, &mut pixels));
        pixels.iter_mut().for_each(|pixel| *pixel += noise.sample(&mut rng));
        pixels[20 * 40 + 8] += 30.0 * camera.noise_std_j;
        let frame = frame(Array2::from_shape_vec((40, 40), pixels).unwrap());
        assert_eq!(estimator.estimate(&frame).unwrap().emitters.len(), FIVE.len());
    }
}

/// The frames, of those in which a dark level has risen and a pixel is hot, in which not the five users are found.
fn wrong_behind_a_measured_lens(name: &str, rise: f64, rules: Rules) -> usize {
    let camera = camera_of(moffat(SIGMA_M), SpotError::AtLeast(1e-3));
    let config = Config {
        name: Some(name.to_owned()),
        rules,
        ..Config::default()
    };
    let mut estimator = build(&config, &camera).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(37);
    let spots = FIVE.map(|at| (at, 100.0));
    let mut is_wrong = |k: usize| {
        let mut pixels = render_density(&camera, &moffat(SIGMA_M), &spots, &mut rng);
        pixels += rise * k as f64 * camera.noise_std_j;
        if k >= 40 {
            pixels[(40, 12)] += 20.0 * camera.noise_std_j;
        }
        let mut frame = frame(pixels);
        frame.index = k as u64;
        frame.time += jiff::SignedDuration::from_millis(100 * k as i64);
        estimator.estimate(&frame).unwrap().emitters.len() != FIVE.len()
    };
    (0..100).filter(|k| is_wrong(*k) && *k >= 45).count()
}

#[test]
fn behind_a_measured_lens_a_rising_level_and_a_hot_pixel_are_no_emitters() {
    for (name, rise) in [("ml", 0.0), ("sequence", 0.01)] {
        let wrong = |rules: Rules| wrong_behind_a_measured_lens(name, rise, rules);
        let (with, without) = (wrong(Rules::default()), wrong(Rules::without("watch_sensor").unwrap()));
        assert!(with <= 1 && without > 25, "{name}: {with} and {without} of 55");
    }
}
