//! Light that is not the users', and counts as coarse as the noise.

use std::sync::Arc;

use ndarray::Array2;
use oapwatch::optics::spot::{Field, SpotShape, Template};
use oapwatch::optics::{self, Camera, SpotError, add_spot};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::frames::{estimator, frame, places};
use crate::lens::{ENERGY_J, FIVE, camera, normalised, render_density};

/// Of twenty frames of five users whose pixels, in units of the noise, are passed through `camera_makes` (of the light, x and y from −1 to 1, and
/// noise): those with another number of emitters, and how many of a hundred emitters lie within their 95 % ellipses.
fn seen(camera: &Camera, camera_makes: impl Fn(f64, [f64; 2], &mut dyn FnMut() -> f64) -> f64) -> (usize, usize) {
    let mut ml = estimator(None, camera);
    let mut rng = ChaCha8Rng::seed_from_u64(39);
    let (mut wrong, mut held) = (0, 0);
    for _ in 0..20 {
        let spots = FIVE.map(|at| at.map(|v| v + rng.random_range(-1e-3..1e-3)));
        let mut pixels = vec![0.0; 64 * 64];
        spots.iter().for_each(|at| add_spot(camera, *at, ENERGY_J, &mut pixels));
        let mut noise = || StandardNormal.sample(&mut rng);
        for (k, pixel) in pixels.iter_mut().enumerate() {
            let at = [k % 64, k / 64].map(|v| (v as f64 + 0.5) / 32.0 - 1.0);
            *pixel = camera.noise_std_j * camera_makes(*pixel / camera.noise_std_j, at, &mut noise);
        }
        let frame = frame(Array2::from_shape_vec((64, 64), pixels).unwrap());
        let emitters = ml.estimate(&frame).unwrap().emitters;
        wrong += usize::from(emitters.len() != FIVE.len());
        let is_held = |at: &&[f64; 2]| normalised(&emitters, camera.to_ground(**at)) < 5.99;
        held += spots.iter().filter(is_held).count();
    }
    (wrong, held)
}

#[test]
fn daylight_that_is_darker_at_the_edge_is_no_emitter() {
    let (wrong, held) = seen(&camera(), |light, [x, y], noise| {
        light + 30.0 * (1.0 - 0.2 * (x * x + y * y)) + 4.0 * x + 2.0 * x * y + noise()
    });
    // Of a hundred, 95 ± 2.
    assert!(wrong == 0 && held >= 88, "{wrong} wrong, {held} of 100 held");
}

#[test]
fn counts_as_coarse_as_the_noise_do_not_hide_that_it_grows_with_the_light() {
    for black in [32.0, 32.4] {
        let (wrong, held) = seen(&camera(), |light, _, noise| {
            (light + (1.0 + 0.05 * light).sqrt() * noise() + black).round() - black
        });
        assert!(wrong == 0 && held >= 88, "{black}: {wrong} wrong, {held} of 100 held");
    }
}

/// Twenty pixels, 11 σ, are all covered by the disc's rings.
#[test]
fn the_rings_of_a_measured_disc_are_no_daylight_on_a_small_sensor() {
    let pitch_m = 0.03 / 64.0;
    let config = optics::Config {
        pixels: [20; 2],
        sensor_size_m: [20.0 * pitch_m; 2],
        spot_sigma_m: Some(1.8 * pitch_m),
        ..Default::default()
    };
    let camera = config.camera().unwrap();
    // The Airy disc (1835) whose core is about as wide as that Gaussian.
    let density = |x: f64, y: f64| {
        let v = x.hypot(y) / (0.75 * camera.spot_sigma_m);
        if v < 1e-6 { 1.0 } else { (2.0 * libm::j1(v) / v).powi(2) }
    };
    let field = Field {
        half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
    };
    let template = Template::of_density(field, 0.5 * pitch_m, 14.0 * pitch_m, density);
    let measured = Camera {
        spot_shape: Some(Arc::new(SpotShape::from_template(&template, 1e-5).unwrap())),
        spot_error: SpotError::Fixed(1e-4),
        ..camera.clone()
    };
    let mut estimator = estimator(None, &measured);
    let mut rng = ChaCha8Rng::seed_from_u64(31);
    let mut wrong = Vec::new();
    for k in 0..20 {
        let at = [0; 2].map(|_| rng.random_range(-3.0..3.0) * pitch_m);
        let angle: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let away = 2.0 * camera.spot_sigma_m;
        let pair = [at, [at[0] + away * angle.cos(), at[1] + away * angle.sin()]];
        let spots = pair.map(|at| (at, 300.0));
        let estimate = estimator
            .estimate(&frame(render_density(&camera, &density, &spots, &mut rng)))
            .unwrap();
        if estimate.emitters.len() != 2 {
            wrong.push((k, places(&estimate)));
        }
    }
    assert!(wrong.is_empty(), "{wrong:?}");
}
