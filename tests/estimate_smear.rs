//! Spots smeared by a camera that moves, drawn from the optics alone: with the motion known their number is right and their covariance
//! honest, for a Gaussian and for a measured spot.

use std::sync::Arc;

use ndarray::Array2;
use oapwatch::estimate::{Config, Emitter, build};
use oapwatch::frame::Frame;
use oapwatch::optics::spot::{Field, SpotShape, Template};
use oapwatch::optics::{self, Camera, Smear, add_spot};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

const ENERGY_J: f64 = 7e-3;
const SIGMA_M: f64 = 1e-3;
/// Places on the sensor, m.
const FIVE: [[f64; 2]; 5] = [[-9e-3, -8e-3], [8e-3, -9e-3], [0.0, 0.0], [4e-3, 2e-3], [-8e-3, 9e-3]];
/// Moments of an exposure: the midpoint rule of smears of 3 σ is then exact to 10⁻⁴ of the peak, a tenth of the noise.
const MOMENTS: usize = 60;

fn camera() -> Camera {
    let config = optics::Config {
        spot_sigma_m: Some(SIGMA_M),
        ..Default::default()
    };
    config.camera().unwrap()
}

fn draw(camera: &Camera, places: &[[f64; 2]], smear: &Smear, rng: &mut ChaCha8Rng) -> Frame {
    let noise = Normal::new(0.0, camera.noise_std_j).unwrap();
    let (ny, nx) = camera.shape();
    let mut pixels: Vec<f64> = (0..ny * nx).map(|_| noise.sample(rng)).collect();
    for &place in places {
        let moved = smear.displacement_m(place);
        for k in 0..MOMENTS {
            let t = (k as f64 + 0.5) / MOMENTS as f64 - 0.5;
            let at = [0, 1].map(|i| place[i] + t * moved[i]);
            add_spot(camera, at, ENERGY_J / MOMENTS as f64, &mut pixels);
        }
    }
    Frame {
        index: 0,
        time: jiff::Timestamp::UNIX_EPOCH,
        pixels: Array2::from_shape_vec((ny, nx), pixels).unwrap(),
        masked: None,
        exposure_s: None,
        energy_scale: 1.0,
    }
}

/// Squared distance of the nearest emitter over its covariance.
fn normalised(emitters: &[Emitter], [x, y]: [f64; 2]) -> f64 {
    let far = |e: &&Emitter| (e.x_m - x).hypot(e.y_m - y);
    let e = emitters.iter().min_by(|a, b| far(a).total_cmp(&far(b))).unwrap();
    let d = [e.x_m - x, e.y_m - y];
    let [[a, b], [_, c]] = e.cov_m2;
    (c * d[0] * d[0] - 2.0 * b * d[0] * d[1] + a * d[1] * d[1]) / (a * c - b * b)
}

/// Mean of the squared error over the stated, of both axes together, over 12 frames; and frames whose number is right.
fn measured(camera: &Camera, smear: &Smear, is_known: bool) -> (f64, usize) {
    let mut estimator = build(&Config::default(), camera).unwrap();
    estimator.set_smear(is_known.then_some(smear));
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let (mut sum, mut right) = (0.0, 0);
    let frames = 12;
    for _ in 0..frames {
        let places = FIVE.map(|at| at.map(|v| v + rng.random_range(-1e-3..1e-3)));
        let frame = draw(camera, &places, smear, &mut rng);
        let found = estimator.estimate(&frame).unwrap().emitters;
        right += usize::from(found.len() == FIVE.len());
        sum += places
            .iter()
            .map(|&p| normalised(&found, camera.to_ground(p)))
            .sum::<f64>();
    }
    (sum / (2 * frames * FIVE.len()) as f64, right)
}

/// A smear of 0.7 σ that no axis is aligned with, and that a turning camera makes different over the field.
fn smear() -> Smear {
    let length_m = 0.7 * 12f64.sqrt() * SIGMA_M;
    Smear {
        at_centre_m: [0.8 * length_m, 0.6 * length_m],
        by_place: [[0.0, -0.05], [0.05, 0.0]],
    }
}

#[test]
fn a_gaussian_spot_is_fitted_as_it_was_smeared() {
    let (unknown, _) = measured(&camera(), &smear(), false);
    let (known, right) = measured(&camera(), &smear(), true);
    println!("squared error over the stated: {unknown} without, {known} with the motion");
    // Of 120 squared normal variates the mean is within 1 ± 0.13 two times in three.
    assert!(right == 12 && (0.6..1.5).contains(&known), "{right} {known}");
    assert!(unknown > 2.0 * known, "{unknown} {known}");
}

#[test]
fn a_measured_spot_is_fitted_as_it_was_smeared() {
    let mut camera = camera();
    let field = Field {
        half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
    };
    // A narrow core on a wide one.
    let density = |x: f64, y: f64| {
        let r2 = (x * x + y * y) / (SIGMA_M * SIGMA_M);
        (-0.5 * r2).exp() + 0.05 * (-0.125 * r2).exp()
    };
    let template = Template::of_density(field, 2.5e-4, 9e-3, density);
    camera.spot_shape = Some(Arc::new(SpotShape::from_template(&template, 1e-5).unwrap()));
    camera.spot_error = Some(0.0);
    let (known, right) = measured(&camera, &smear(), true);
    assert!(right == 12 && (0.6..1.5).contains(&known), "{right} {known}");
}
