//! Every promise of the stability study's catalogue that holds in seconds, and the checks that the study cannot make of itself.

mod invariants;
#[path = "../reference/mod.rs"]
mod reference;

use oapwatch::estimate;
use oapwatch::optics::Config;
use oapwatch::study::stability::{Options, catalogue, markdown, trial};
use proptest::prelude::*;

fn options(frames: usize) -> Options {
    Options {
        frames,
        seed: 7,
        estimator: estimate::Config::default(),
    }
}

/// Cases that need hundreds of frames or a release build to say anything; `oapwatch stability` shows them.
fn is_slow(name: &str) -> bool {
    ["forty", "five in a line", "100 × 100", "constant", "ramp"]
        .iter()
        .any(|s| name.contains(s))
}

#[test]
fn the_catalogue_holds() {
    let rows: Vec<_> = catalogue()
        .into_iter()
        .filter(|c| !is_slow(&c.name))
        .map(|c| c.run(&options(2)))
        .collect();
    let broken: Vec<_> = rows.iter().filter(|r| !r.seen.holds).cloned().collect();
    assert!(broken.is_empty(), "{}", markdown(&broken, &options(2)));
    assert!(rows.len() > 80);
}

#[test]
fn a_malformed_estimate_is_noticed() {
    let camera = trial::camera([16, 16], 1e-3);
    let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("the default");
    let source = trial::Source {
        sensor_m: [0.0, 0.0],
        energy_j: trial::energy(&camera, 100.0),
    };
    let sound = estimator
        .estimate(&trial::noiseless(&camera, &[source]))
        .expect("a usable frame");
    assert_eq!(sound.emitters.len(), 1);
    assert_eq!(trial::faults(&sound), Vec::<String>::new());
    let broken = |change: fn(&mut estimate::Emitter)| {
        let mut estimate = sound.clone();
        change(&mut estimate.emitters[0]);
        !trial::faults(&estimate).is_empty()
    };
    assert!(broken(|e| e.x_m = f64::NAN));
    assert!(broken(|e| e.cov_m2[0][0] = -1e-12));
    assert!(broken(|e| e.cov_m2[0][1] = 1e-9 + e.cov_m2[0][0]));
    assert!(broken(|e| e.energy_j = -1.0));
}

#[test]
fn claimed_covariances_are_the_cramer_rao_bound_as_two_emitters_approach() {
    let rows = reference::table(
        include_str!("../reference/bound.csv"),
        ["d", "ratio", "xx", "xy", "yy", "energy"],
    );
    // One unit a pixel, σ and noise 1, ground and sensor alike.
    let config = Config {
        altitude_m: 1.0,
        plane_distance_m: 1.0,
        pixels: [16, 16],
        sensor_size_m: [16.0, 16.0],
        spot_sigma_m: Some(1.0),
        noise_std_j: 1.0,
        ..Config::default()
    };
    let camera = config.camera().expect("a valid camera");
    // Below 0.5σ nobody can tell the two apart at this signal-to-noise ratio.
    let resolvable = rows.into_iter().filter(|row| row[0] >= 0.5);
    let errors = resolvable.flat_map(|[d, ratio, xx, xy, yy, energy]| {
        let half = 0.5 * d / 2f64.sqrt();
        let sources = [(-half, 1e3), (half, 1e3 * ratio)].map(|(shift, energy_j)| trial::Source {
            sensor_m: [0.3 + shift, 0.3 + shift],
            energy_j,
        });
        let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("the default");
        let found = estimator
            .estimate(&trial::noiseless(&camera, &sources))
            .expect("a usable frame")
            .emitters;
        assert_eq!(found.len(), 2, "d = {d}, 1:{ratio}");
        let first = found.iter().min_by(|a, b| a.x_m.total_cmp(&b.x_m)).expect("two");
        let [[a, b], [_, c]] = first.cov_m2;
        [
            (a - xx) / xx,
            (b - xy) / xx,
            (c - yy) / yy,
            first.energy_std_j.powi(2) / energy - 1.0,
        ]
        .map(f64::abs)
    });
    // The fit stops within 1e-3 of a standard deviation of the truth, where the bound itself changes by that much.
    assert!(reference::quantiles("covariance against the bound", errors).max <= 1e-2);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(11), ..ProptestConfig::default() })]

    /// Frames of any numbers at all on arrays of any shape: no panic, nothing malformed.
    #[test]
    fn nothing_that_is_said_is_malformed(
        pixels in [1usize..12, 1usize..12],
        sigma in -5.0f64..0.0,
        exponents in prop::collection::vec((-20.0f64..4.0, prop::bool::ANY), 144),
        holes in prop::collection::vec(0u8..20, 144),
    ) {
        let camera = trial::camera(pixels, 10f64.powf(sigma));
        let value = |k: usize| match holes[k] {
            0 => f64::NAN,
            1 => f64::INFINITY,
            _ => 10f64.powf(exponents[k].0) * if exponents[k].1 { 1.0 } else { -0.1 },
        };
        let frame = trial::frame(ndarray::Array2::from_shape_fn(camera.shape(), |(y, x)| value(12 * y + x)));
        let known = estimate::KnownPower { energies_j: vec![1.0], relative_std: 0.1, share: 0.95, attenuation_per_m: 0.0 };
        for name in ["ml", "map"] {
            let config = estimate::Config { name: Some(name.into()), known_power: Some(known.clone()), ..Default::default() };
            let mut estimator = estimate::build(&config, &camera).expect("an estimator");
            if let Ok(estimate) = estimator.estimate(&frame) {
                prop_assert_eq!(trial::faults(&estimate), Vec::<String>::new());
            }
        }
    }
}
