//! The sensor, the log or our own pose fails.

use oapwatch::monitor::AlertKind::*;

use super::stage::{Expect, Story, review, scene_file};

#[test]
fn a_shift_of_all_claims_is_our_own_pose_and_nothing_else() {
    for seed in 0..3 {
        let mut story = Story::with(seed, "");
        story.tamper = Box::new(|t, made| {
            if t >= 8.0 {
                made.claims.iter_mut().for_each(|c| c.x_m += 6.0);
            }
        });
        review(&story).expect(&[(PoseInconsistent, None, 8.0, 10.5)]);
    }
}

#[test]
fn a_frozen_sensor_is_lost() {
    let mut story = Story::with(1, "");
    let kept = std::cell::RefCell::new(None);
    story.tamper = Box::new(move |t, made| {
        if t >= 8.0 {
            let frozen = kept
                .borrow_mut()
                .get_or_insert_with(|| made.frame.pixels.clone())
                .clone();
            made.frame.pixels = frozen;
        }
    });
    // The first frozen frame is a good one; a second without another is the limit.
    review(&story).expect(&[(SensorLost, None, 9.0, 9.2)]);
}

#[test]
fn a_blinded_dark_or_dead_sensor_is_lost_and_found_again() {
    for value in [1.0, 0.0, f64::NAN, f64::INFINITY, -1.0] {
        let mut story = Story::with(2, "");
        story.change(|scene| scene.optics.saturation_j = Some(1e-2));
        story.tamper = Box::new(move |t, made| {
            if (8.0..12.0).contains(&t) {
                made.frame.pixels.fill(value);
            }
        });
        let told = review(&story);
        told.expect(&[(SensorLost, None, 8.8, 9.2)]);
        let cleared = told.cleared();
        assert!(
            cleared.len() == 1 && (12.0..13.5).contains(&cleared[0]),
            "{value}: {cleared:?}"
        );
    }
}

/// Noise as without light: every beam went out in the same frame.
#[test]
fn a_covered_lens_is_a_lost_sensor_and_no_absent_users() {
    let mut story = Story::with(3, "");
    let dark = {
        let mut empty = Story::only(4, "");
        empty.seconds = 1.0;
        empty
    };
    let dark = dark.frames();
    story.tamper = Box::new(move |t, made| {
        if t >= 8.0 {
            let mut pixels = dark[(t * 10.0) as usize % dark.len()].clone();
            // No two frames are alike.
            pixels *= 1.0 + 1e-6 * t;
            made.frame.pixels = pixels;
        }
    });
    review(&story).expect(&[(SensorLost, None, 8.8, 9.2)]);
}

#[test]
fn a_log_that_stops_is_stale_and_hides_no_intruder() {
    let mut story = Story::with(
        5,
        "[[intruder]]\nname = \"e\"\nmotion.still = [0, 0]\npresent = { from_s = 25 }",
    );
    story.seconds = 30.0;
    story.tamper = Box::new(|t, made| {
        if t >= 8.0 {
            made.claims.clear();
        }
    });
    review(&story).expect(&[(ClaimsStale, None, 12.0, 15.0), (UnclaimedEmitter, None, 25.0, 26.0)]);
}

/// A lamp over half of the array: the alert is there in a second, and no frame takes long to say nothing.
#[test]
fn a_lamp_on_the_lens_is_a_lost_sensor_at_once() {
    let mut story = scene_file(1, "config/scenes/blinding.toml");
    story.seconds = 14.0;
    let began = std::time::Instant::now();
    let told = review(&story);
    // Forty dazzled frames that were fitted took half a minute and more.
    assert!(began.elapsed().as_secs() < 20, "{:?}", began.elapsed());
    told.expect(&[(SensorLost, None, 10.9, 11.2)]);
}
