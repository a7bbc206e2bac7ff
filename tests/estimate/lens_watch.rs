//! Frames together through a lens that nobody has calibrated.

use jiff::SignedDuration;
use oapwatch::estimate::Rules;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::frames::frame;
use crate::lens::{FIVE, SIGMA_M, camera, moffat, render_density};

/// Of the frames of a stream through a Moffat halo after its first two seconds, those with another number than five emitters.
fn wrong(snr: f64, rules: Rules) -> usize {
    let camera = camera();
    let config = oapwatch::estimate::Config {
        name: Some("sequence".into()),
        rules,
        ..Default::default()
    };
    let mut sequence = oapwatch::estimate::build(&config, &camera).unwrap();
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
