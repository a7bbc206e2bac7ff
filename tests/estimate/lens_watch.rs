//! Frames together through a lens that nobody has calibrated.

use jiff::SignedDuration;
use oapwatch::estimate::{Config, Estimator, Rules, build};
use oapwatch::optics::Camera;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::frames::frame;
use crate::lens::{FIVE, SIGMA_M, camera, moffat, render_density};

fn sequence(rules: Rules, camera: &Camera) -> Box<dyn Estimator> {
    let config = Config {
        name: Some("sequence".into()),
        rules,
        ..Default::default()
    };
    build(&config, camera).unwrap()
}

/// Of the frames of a stream through a Moffat halo after its first two seconds, those with another number than five emitters.
fn wrong(snr: f64, rules: Rules) -> usize {
    let camera = camera();
    let mut sequence = sequence(rules, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(38);
    let spots = FIVE.map(|at| (at, snr));
    let numbers = (0..70).map(|k| {
        let mut frame = frame(render_density(&camera, &moffat(SIGMA_M), &spots, &mut rng));
        frame.time += SignedDuration::from_millis(100 * k);
        sequence.estimate(&frame).unwrap().emitters.len()
    });
    numbers.skip(20).filter(|n| *n != FIVE.len()).count()
}

#[test]
fn a_halo_is_no_emitter_to_frames_together() {
    let with = wrong(30.0, Rules::default());
    let without = wrong(30.0, Rules::without("watch_lens").expect("a rule"));
    assert!(with == 0 && without > 20, "{with} and {without} of 50 frames");
}

#[test]
fn nor_is_one_that_no_single_frame_shows() {
    let with = wrong(15.0, Rules::default());
    let without = wrong(15.0, Rules::without("stack_misfits").expect("a rule"));
    assert!(with == 0 && without > 20, "{with} and {without} of 50 frames");
}

/// Of 200 frames of spots that are `widens` times as wide, those with another number than five emitters.
fn wrong_while(widens: impl Fn(f64) -> f64, rules: Rules) -> usize {
    let camera = camera();
    let mut sequence = sequence(rules, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(39);
    let spots = FIVE.map(|at| (at, 100.0));
    let numbers = (0..200).map(|k| {
        let sigma_m = SIGMA_M * widens(f64::from(k));
        let gaussian = move |x: f64, y: f64| (-0.5 * (x * x + y * y) / (sigma_m * sigma_m)).exp();
        let mut frame = frame(render_density(&camera, &gaussian, &spots, &mut rng));
        frame.time += SignedDuration::from_millis(100 * i64::from(k));
        sequence.estimate(&frame).unwrap().emitters.len()
    });
    numbers.filter(|n| *n != FIVE.len()).count()
}

#[test]
fn spots_that_grow_wider_as_the_lens_warms_up_are_no_pairs() {
    for widens in [|k: f64| 1.0 + 2e-4 * k, |k: f64| if k < 100.0 { 1.0 } else { 1.04 }] {
        let with = wrong_while(widens, Rules::default());
        let without = wrong_while(widens, Rules::without("learn_width").expect("a rule"));
        assert!(with < 20 && without > 80, "{with} and {without} of 200 frames");
    }
}
