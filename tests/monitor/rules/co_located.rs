//! A second beam within a user's spot.

use oapwatch::monitor::AlertKind::*;

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, crowd, tell};

/// Equal beams 30 cm apart, after half a minute of one.
#[test]
fn a_stranger_within_a_users_spot_is_alerted_and_cleared_when_gone() {
    let mut raised_at: Vec<f64> = Vec::new();
    for seed in SEEDS {
        let mut actors = crowd();
        let victim = |t: f64| [15.0 * (0.06 * t + 1.0).sin(), -50.0 + 15.0 * (0.05 * t + 2.0).cos()];
        actors.push(Actor::intruder(move |t| {
            let [x, y] = victim(t);
            (30.0..45.0).contains(&t).then_some([x + 0.3, y])
        }));
        let mut story = Story::new(seed, actors);
        story.seconds = 60.0;
        let told = tell(&story);
        // Of sixty strangers in `study shadow` the slowest is alerted after 7.8 s.
        told.expect(&[(UnclaimedEmitter, None, 30.5, 38.0)]);
        raised_at.push(told.raised()[0].2);
        let alert = &told.events[0].alert;
        assert_eq!(alert.evidence["shares_the_spot_of"], "u-1");
        let cleared = told.cleared();
        assert!(
            cleared.len() == 1 && (45.5..51.0).contains(&cleared[0].2),
            "{cleared:?}"
        );
    }
    raised_at.sort_by(f64::total_cmp);
    assert!(raised_at[raised_at.len() / 2] < 36.0, "{raised_at:?}");
}

/// A user whose light grows by a quarter for good is pointed better, and no two.
#[test]
fn a_user_who_becomes_a_quarter_brighter_raises_nothing() {
    let mut actors = crowd();
    let (mut dim, mut bright) = (Actor::new("u-1", |_| [0.0, -50.0]), Actor::intruder(|_| None));
    dim = dim.beam(|t| (t < 30.0).then_some([0.0, -50.0]));
    bright = bright.beam(|t| (t >= 30.0).then_some([0.0, -50.0]));
    bright.energy_j *= 1.25;
    actors[1] = dim;
    actors.push(bright);
    let mut story = Story::new(3, actors);
    story.seconds = 60.0;
    tell(&story).expect(&[]);
}
