//! Our own pose is off: one alert, and users are still judged.

use oapwatch::monitor::AlertKind::*;

use super::stories::{Actor, Story, crowd, tell};

#[test]
fn a_heading_that_is_off_from_the_start_is_our_own_error() {
    for (seed, degrees) in [(1, 3.0f64), (2, -6.0)] {
        let mut story = Story::new(seed, crowd());
        story.turn = Box::new(move |_| [0.0, degrees.to_radians()]);
        tell(&story).expect(&[(PoseInconsistent, None, 0.0, 3.0)]);
    }
}

#[test]
fn an_altitude_that_drifts_is_our_own_error() {
    let mut story = Story::new(3, crowd());
    story.seconds = 60.0;
    // Twelve metres of three hundred over forty seconds.
    story.turn = Box::new(|t| [0.001 * (t - 10.0).clamp(0.0, 40.0), 0.0]);
    let told = tell(&story);
    told.expect(&[(PoseInconsistent, None, 20.0, 50.0)]);
    let scale = told.events[0].alert.evidence["scale"].as_f64().unwrap();
    assert!((1.01..1.04).contains(&scale), "{scale}");
}

#[test]
fn a_small_turn_is_corrected_and_no_alert() {
    let mut story = Story::new(4, crowd());
    story.seconds = 60.0;
    story.turn = Box::new(|_| [0.004, -0.008]);
    tell(&story).expect(&[]);
}

#[test]
fn who_lies_while_we_are_turned_is_found() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t >= 20.0).then_some([20.0, 10.0])));
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).claim(|t| Some([if t < 12.0 { 80.0 } else { 90.0 }, -50.0]));
    let mut story = Story::new(5, actors);
    story.turn = Box::new(|_| [0.0, 0.06]);
    tell(&story).expect(&[
        (PoseInconsistent, None, 0.0, 3.0),
        (PositionMismatch, Some("u-2"), 12.0, 14.0),
        (UnclaimedEmitter, None, 20.0, 21.0),
    ]);
}
