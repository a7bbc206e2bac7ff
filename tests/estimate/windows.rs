//! Large sensors from outside: windows of a frame give the answers of the whole frame, find all emitters, and say where they reach a limit.

use std::sync::Arc;
use std::time::Instant;

use ndarray::{Array2, s};
use oapwatch::estimate::{Config, Emitter, Estimate, Estimator, Flags, Rules, build};
use oapwatch::frame::Frame;
use oapwatch::optics::spot::{Component, Field, FieldPolynomial, SpotShape, Template};
use oapwatch::optics::{self, Axis, Camera, Smear, SpotError, add_spot, psf};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::frames;

/// Pixels per σ, and the energy of a spot whose brightest pixel is a hundred times the noise.
const SIGMA: f64 = 2.1;
const ENERGY: f64 = 100.0 * std::f64::consts::TAU * SIGMA * SIGMA;

fn camera(pixels: [usize; 2]) -> Camera {
    let config = optics::Config {
        pixels,
        sensor_size_m: pixels.map(|n| n as f64 * 1e-3 / SIGMA),
        spot_sigma_m: Some(1e-3),
        ..Default::default()
    };
    config.camera().unwrap()
}

fn estimator(name: &str, rules: Rules, camera: &Camera) -> Box<dyn Estimator> {
    let config = Config {
        name: Some(name.to_owned()),
        rules,
        ..Default::default()
    };
    build(&config, camera).unwrap()
}

/// Spots at pixels from the corner, with their energies in units of the noise.
fn frame(camera: &Camera, spots: &[([f64; 2], f64)], seed: u64) -> Frame {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut pixels = Array2::from_shape_simple_fn(camera.shape(), || -> f64 { StandardNormal.sample(&mut rng) });
    let reach = (10.0 * SIGMA) as usize;
    for (place, energy) in spots {
        let along = |axis: &Axis, at: f64| {
            let (first, last) = ((at as usize).saturating_sub(reach), (at as usize + reach).min(axis.n));
            let fraction = |k: usize| psf::pixel_fraction(k as f64, k as f64 + 1.0, at, SIGMA);
            (first..last, (first..last).map(fraction).collect::<Vec<f64>>())
        };
        let ((x, fx), (y, fy)) = (along(&camera.x, place[0]), along(&camera.y, place[1]));
        for ((j, i), pixel) in pixels.slice_mut(s![y, x]).indexed_iter_mut() {
            *pixel += energy * fy[j] * fx[i];
        }
    }
    frames::frame(pixels * camera.noise_std_j)
}

/// Spots of the camera's own shape, smeared.
fn smeared(camera: &Camera, spots: &[([f64; 2], f64)], smear: &Smear, seed: u64) -> Frame {
    /// Moments of an exposure: the midpoint rule of smears of a σ is exact to 10⁻⁴ of the peak.
    const MOMENTS: usize = 20;
    let dark = frame(camera, &[], seed).pixels;
    let (shape, mut pixels) = (dark.dim(), dark.into_raw_vec_and_offset().0);
    for (place, energy) in spots {
        let place = [(&camera.x, place[0]), (&camera.y, place[1])].map(|(axis, at)| axis.edge(0) + at * axis.pitch_m);
        let moved = smear.displacement_m(place);
        for k in 0..MOMENTS {
            let t = (k as f64 + 0.5) / MOMENTS as f64 - 0.5;
            let at = [0, 1].map(|i| place[i] + t * moved[i]);
            add_spot(camera, at, energy * camera.noise_std_j / MOMENTS as f64, &mut pixels);
        }
    }
    frames::frame(Array2::from_shape_vec(shape, pixels).unwrap())
}

/// A round spot with a tail that points away from the sensor's middle and grows towards its edges, as coma does.
fn with_tails(camera: Camera) -> Camera {
    let sigma = camera.spot_sigma_m;
    let field = Field {
        half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
    };
    let gaussian = |x: f64, y: f64| (-0.5 * (x * x + y * y) / (sigma * sigma)).exp();
    let tail = |along: f64, x: f64, y: f64| 0.1 * (along / sigma).powi(3) * gaussian(x, y);
    let of = |density: &dyn Fn(f64, f64) -> f64, field_by: Vec<f64>| Component {
        field: FieldPolynomial(field_by),
        ..Template::of_density(field, 0.25 * sigma, 8.0 * sigma, density).components[0].clone()
    };
    let template = Template {
        field,
        knot_m: 0.25 * sigma,
        components: vec![
            of(&gaussian, vec![1.0]),
            of(&|x, y| tail(x, x, y), vec![0.0, 1.0]),
            of(&|x, y| tail(y, x, y), vec![0.0, 0.0, 1.0]),
        ],
    };
    Camera {
        spot_shape: SpotShape::from_template(&template, 1e-6).map(Arc::new),
        ..camera
    }
}

/// Where an emitter is, pixels from the corner.
fn pixel(camera: &Camera, emitter: &Emitter) -> [f64; 2] {
    let [x, y] = emitter.sensor_m;
    [
        (x - camera.x.edge(0)) / camera.x.pitch_m,
        (y - camera.y.edge(0)) / camera.y.pitch_m,
    ]
}

/// The emitter within a pixel of a place.
fn at<'a>(camera: &Camera, estimate: &'a Estimate, place: [f64; 2]) -> Option<&'a Emitter> {
    let distance = |e: &Emitter| {
        let [x, y] = pixel(camera, e);
        (x - place[0]).hypot(y - place[1])
    };
    estimate.emitters.iter().find(|e| distance(e) < 1.0)
}

/// Places with at least `apart` σ between each two.
fn scatter(pixels: [usize; 2], count: usize, apart: f64, seed: u64) -> Vec<[f64; 2]> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut places: Vec<[f64; 2]> = Vec::new();
    while places.len() < count {
        let next = pixels.map(|n| rng.random_range(3.0..n as f64 - 3.0));
        let is_apart = |p: &[f64; 2]| (p[0] - next[0]).hypot(p[1] - next[1]) > apart * SIGMA;
        if places.iter().all(is_apart) {
            places.push(next);
        }
    }
    places
}

/// Largest distance of two estimates' emitters on the ground, in standard deviations of the first along each axis.
fn difference(camera: &Camera, a: &Estimate, b: &Estimate) -> f64 {
    assert_eq!(a.emitters.len(), b.emitters.len());
    let own = |e: &Emitter| {
        let other = at(camera, b, pixel(camera, e)).expect("the same emitter");
        let [dx, dy] = [e.x_m - other.x_m, e.y_m - other.y_m];
        (dx.powi(2) / e.cov_m2[0][0]).max(dy.powi(2) / e.cov_m2[1][1]).sqrt()
    };
    a.emitters.iter().map(own).fold(0.0, f64::max)
}

#[test]
fn two_hundred_emitters_are_all_found_and_none_is_invented() {
    let camera = camera([512, 512]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    let spots: Vec<_> = scatter([512, 512], 200, 4.0, 1)
        .into_iter()
        .map(|p| (p, ENERGY))
        .collect();
    let found = ml.estimate(&frame(&camera, &spots, 2)).unwrap();
    assert_eq!(found.emitters.len(), 200);
    assert!(spots.iter().all(|(p, _)| at(&camera, &found, *p).is_some()));
    assert!(!found.is_limited && !found.is_cut_short);
    assert!((found.reduced_chi2 - 1.0).abs() < 0.02, "{}", found.reduced_chi2);
}

#[test]
fn windows_give_the_answers_of_the_whole_frame() {
    let camera = camera([256, 256]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    let mut whole = estimator("ml", Rules::without("windows").unwrap(), &camera);
    for seed in 0..4 {
        let energies = [1.0, 0.3, 0.1, 2.0];
        let places = scatter([256, 256], 9, 4.0, seed).into_iter().enumerate();
        let mut spots: Vec<_> = places.map(|(i, p)| (p, ENERGY * energies[i % 4])).collect();
        // Across the sensor's edge, and on borders of cells and blocks.
        spots[0].0 = [-1.0, 100.3];
        spots[1].0 = [128.0, 128.0];
        let frame = frame(&camera, &spots, 10 + seed);
        let (by_windows, at_once) = (ml.estimate(&frame).unwrap(), whole.estimate(&frame).unwrap());
        let far = difference(&camera, &at_once, &by_windows);
        // What a window cuts off is 1 % of a faint spot's information.
        assert!(far < 0.1, "{far} standard deviations");
        for e in &at_once.emitters {
            let other = at(&camera, &by_windows, pixel(&camera, e)).unwrap();
            assert_eq!(e.flags, other.flags);
            assert!((e.cov_m2[0][0] / other.cov_m2[0][0] - 1.0).abs() < 0.02);
        }
        assert_eq!(ml.estimate(&frame).unwrap().emitters.len(), by_windows.emitters.len());
    }
}

#[test]
fn answers_are_continuous_where_windows_become_one() {
    let camera = camera([256, 256]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    let mut whole = estimator("ml", Rules::without("windows").unwrap(), &camera);
    for step in 0..40 {
        let apart = 3.0 + 0.25 * step as f64;
        let second = [100.0 + apart * SIGMA * 0.8, 100.0 + apart * SIGMA * 0.6];
        let frame = frame(&camera, &[([100.0, 100.0], ENERGY), (second, 0.2 * ENERGY)], 5);
        let (by_windows, at_once) = (ml.estimate(&frame).unwrap(), whole.estimate(&frame).unwrap());
        let far = difference(&camera, &at_once, &by_windows);
        assert!(far < 0.1, "{far} standard deviations at {apart} σ");
    }
}

#[test]
fn a_faint_emitter_between_bright_ones_is_found() {
    let camera = camera([256, 256]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    for seed in 0..10 {
        let faint = [128.0 + 0.1 * seed as f64, 128.0];
        let spots = [
            ([111.0, 128.0], 3.0 * ENERGY),
            ([145.0, 128.0], 3.0 * ENERGY),
            (faint, 0.04 * ENERGY),
        ];
        let found = ml.estimate(&frame(&camera, &spots, seed)).unwrap();
        assert_eq!(found.emitters.len(), 3);
        assert!(at(&camera, &found, faint).is_some());
    }
}

#[test]
fn other_windows_light_masks_no_emitter_and_unusable_pixels_do() {
    let camera = camera([256, 256]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    // The windows of two spots on a diagonal overlap.
    let spots = [
        ([100.0, 100.0], ENERGY),
        ([116.0, 116.0], ENERGY),
        ([200.0, 60.0], ENERGY),
    ];
    let mut frame = frame(&camera, &spots, 3);
    frame.pixels[[61, 201]] = f64::NAN;
    let found = ml.estimate(&frame).unwrap();
    let flags = spots.map(|(p, _)| at(&camera, &found, p).unwrap().flags);
    assert_eq!(flags, [Flags::empty(), Flags::empty(), Flags::MASKED]);
}

#[test]
fn a_limit_that_is_reached_is_flagged() {
    let large = camera([1024, 1024]);
    let grid =
        |n: usize, pitch: f64| (0..n * n).map(move |k| [0, 1].map(|a| pitch * ((k / n.pow(a) % n) as f64 + 0.5)));
    let spots: Vec<_> = grid(33, 31.0).map(|p| (p, ENERGY)).collect();
    let found = estimator("ml", Rules::default(), &large)
        .estimate(&frame(&large, &spots, 1))
        .unwrap();
    assert!(
        found.is_limited && found.emitters.len() == 1000,
        "{}",
        found.emitters.len()
    );
    let small = camera([64, 64]);
    let spots: Vec<_> = grid(10, 6.4).map(|p| (p, ENERGY)).collect();
    let found = estimator("greedy-fit", Rules::default(), &small)
        .estimate(&frame(&small, &spots, 1))
        .unwrap();
    assert!(found.is_limited && found.emitters.len() < 100);
    assert!(found.emitters.iter().all(|e| e.flags.contains(Flags::LIMIT_REACHED)));
}

/// Thousands of peaks in one hypothesis took gigabytes and minutes.
#[test]
fn light_in_rows_is_searched_with_as_many_sources_as_a_hypothesis_may_have() {
    let camera = Camera {
        spot_sigma_m: 1e-3 / SIGMA,
        ..camera([128, 128])
    };
    let rows = Array2::from_shape_fn((128, 128), |(y, _)| if y % 3 == 0 { 1000.0 } else { 0.0 });
    let lit = Frame {
        pixels: frame(&camera, &[], 1).pixels + rows * camera.noise_std_j,
        ..frame(&camera, &[], 1)
    };
    for (name, most) in [("peak-fit", 300), ("subpixel-peak", 300), ("ml", 80)] {
        let began = Instant::now();
        let found = estimator(name, Rules::default(), &camera).estimate(&lit).unwrap();
        assert!(found.is_limited && found.emitters.len() <= most, "{name}");
        assert!(began.elapsed().as_secs() < 30, "{name}: {:?}", began.elapsed());
    }
}

#[test]
fn a_dark_level_and_noise_that_the_config_does_not_know_are_measured() {
    let camera = camera([256, 256]);
    let mut ml = estimator("ml", Rules::default(), &camera);
    let places = scatter([256, 256], 5, 12.0, 7);
    let spots: Vec<_> = places.iter().map(|p| (*p, ENERGY)).collect();
    let plain = frame(&camera, &spots, 8);
    let expected = ml.estimate(&plain).unwrap();
    let mut lit = plain.clone();
    lit.pixels += 2.0 * camera.noise_std_j;
    let found = ml.estimate(&lit).unwrap();
    let far = difference(&camera, &expected, &found);
    assert!(far < 0.1, "{far} standard deviations above a level");
    let mut noisy = plain;
    noisy.pixels *= 1.5;
    let found = ml.estimate(&noisy).unwrap();
    let far = difference(&camera, &expected, &found);
    assert!(far < 0.1, "{far} standard deviations in another noise");
    assert!((found.reduced_chi2 - 1.0).abs() < 0.05, "{}", found.reduced_chi2);
    assert!(found.emitters.iter().all(|e| e.flags.is_empty()));
}

#[test]
fn a_measured_spot_that_varies_over_the_sensor_is_the_same_in_windows() {
    let camera = with_tails(camera([256, 192]));
    let mut ml = estimator("ml", Rules::default(), &camera);
    let mut whole = estimator("ml", Rules::without("windows").unwrap(), &camera);
    let spots: Vec<_> = scatter([256, 192], 7, 6.0, 3)
        .into_iter()
        .map(|p| (p, ENERGY))
        .collect();
    let frame = smeared(&camera, &spots, &Smear::default(), 4);
    let (by_windows, at_once) = (ml.estimate(&frame).unwrap(), whole.estimate(&frame).unwrap());
    let far = difference(&camera, &at_once, &by_windows);
    assert!(far < 0.1, "{far} standard deviations");
    for (place, _) in &spots {
        let e = at(&camera, &by_windows, *place).expect("an emitter within a pixel");
        let off = [0, 1].map(|k| (pixel(&camera, e)[k] - place[k]) * camera.ground_scale() * camera.x.pitch_m);
        assert!(
            (0..2).all(|k| off[k].abs() < 5.0 * e.cov_m2[k][k].sqrt()),
            "{off:?} against {:?}",
            e.cov_m2
        );
    }
}

#[test]
fn spots_smeared_differently_over_the_sensor_are_the_same_in_windows() {
    let camera = camera([256, 192]);
    let spots: Vec<_> = scatter([256, 192], 7, 8.0, 5)
        .into_iter()
        .map(|p| (p, ENERGY))
        .collect();
    // A platform that turns: up to 2.4 σ at the corners.
    let smear = Smear {
        at_centre_m: [3e-4, 0.0],
        by_place: [[0.0, -0.03], [0.03, 0.0]],
        ..Smear::default()
    };
    let frame = smeared(&camera, &spots, &smear, 6);
    let [by_windows, at_once] = [Rules::default(), Rules::without("windows").unwrap()].map(|rules| {
        let mut ml = estimator("ml", rules, &camera);
        ml.set_smear(Some(&smear));
        ml.estimate(&frame).unwrap()
    });
    assert_eq!(by_windows.emitters.len(), spots.len());
    let far = difference(&camera, &at_once, &by_windows);
    assert!(far < 0.1, "{far} standard deviations");
}

#[test]
fn a_ghost_in_a_window_of_its_own_is_no_emitter_under_a_spot_error() {
    let camera = Camera {
        spot_error: SpotError::Fixed(0.04),
        ..camera([256, 256])
    };
    let mut ml = estimator("ml", Rules::default(), &camera);
    let bright = [[60.0, 60.0], [180.0, 100.0], [100.0, 200.0]];
    // Ten σ away, 1 % of the light: 20 times the noise of a pixel.
    let ghosts = bright.map(|[x, y]| ([x + 17.0, y - 12.0], 0.2 * ENERGY));
    let spots = [bright.map(|p| (p, 20.0 * ENERGY)).as_slice(), &ghosts].concat();
    let found = ml.estimate(&frame(&camera, &spots, 9)).unwrap();
    assert_eq!(found.emitters.len(), bright.len());
    // A beam as faint far from any other is one.
    let spots = [spots.as_slice(), &[([220.0, 220.0], 0.2 * ENERGY)]].concat();
    let found = ml.estimate(&frame(&camera, &spots, 9)).unwrap();
    assert!(at(&camera, &found, [220.0, 220.0]).is_some());
    assert_eq!(found.emitters.len(), bright.len() + 1);
}
