//! Frames together through a lens that nobody has calibrated.

use jiff::SignedDuration;
use oapwatch::estimate::Rules;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::frames::frame;
use crate::lens::{FIVE, SIGMA_M, camera, moffat, render_density};

#[test]
fn a_halo_is_no_emitter_to_frames_together() {
    let camera = camera();
    let wrong = |rules: Rules| {
        let config = oapwatch::estimate::Config {
            name: Some("sequence".into()),
            rules,
            ..Default::default()
        };
        let mut sequence = oapwatch::estimate::build(&config, &camera).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(38);
        let spots = FIVE.map(|at| (at, 30.0));
        let numbers = (0..50).map(|k| {
            let mut frame = frame(render_density(&camera, &moffat(SIGMA_M), &spots, &mut rng));
            frame.time += SignedDuration::from_millis(100 * k);
            sequence.estimate(&frame).unwrap().emitters.len()
        });
        numbers.skip(20).filter(|n| *n != FIVE.len()).count()
    };
    let with = wrong(Rules::default());
    let without = wrong(Rules::without("watch_lens").expect("a rule"));
    assert!(with == 0 && without > 20, "{with} and {without} of 30 frames");
}
