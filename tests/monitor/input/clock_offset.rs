//! A log whose clock is off.

use crate::stories::{Actor, Expect, Story, tell};

/// On bicycles, with a log whose clock is off by most of a second: seven metres along the way.
#[test]
fn a_clock_within_limits_is_no_false_position() {
    for (seed, late) in [0.9, -0.9].into_iter().enumerate() {
        let actors = (0..6).map(|k| {
            let (x, y) = (-80.0 + 80.0 * f64::from(k % 3), -50.0 + 100.0 * f64::from(k / 3));
            let way = move |t: f64| {
                let angle = 0.27 * t + 2.0 * f64::from(k);
                [x + 30.0 * angle.cos(), y + 30.0 * angle.sin()]
            };
            let mut actor = Actor::new(&format!("u-{k}"), way).claim(move |t| Some(way(t - late)));
            actor.phase_s = 0.13 * f64::from(k);
            actor
        });
        let mut story = Story::new(seed as u64, actors.collect());
        story.seconds = 60.0;
        // A clock that is behind stamps what comes in later.
        story.delivery = Box::new(move |t| Some(t + f64::max(0.0, -late)));
        tell(&story).expect(&[]);
    }
}
