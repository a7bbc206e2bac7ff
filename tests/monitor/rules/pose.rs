//! Our own pose is off: one alert, and users are still judged.

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::PositionStatus;

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, crowd, tell};

#[test]
fn a_shift_of_everybody_is_our_own_pose() {
    for (seed, shift) in [[8.0, 0.0], [0.0, -3.5], [20.0, 20.0]].into_iter().enumerate() {
        let mut story = Story::new(seed as u64, crowd());
        story.shift = Box::new(move |t| if t < 10.0 { [0.0, 0.0] } else { shift });
        let told = tell(&story);
        told.expect(&[(PoseInconsistent, None, 10.0, 12.0)]);
        let last = told.reports.last().unwrap();
        assert!(
            last.emitters.iter().all(|e| e.status == PositionStatus::Verified),
            "{last:#?}"
        );
    }
}

#[test]
fn a_pose_that_wanders_within_limits_is_corrected_silently() {
    let mut story = Story::new(3, crowd());
    story.seconds = 60.0;
    story.shift = Box::new(|t| [1.5 * (0.2 * t).sin(), 1.0 * (0.13 * t).cos()]);
    tell(&story).expect(&[]);
}

#[test]
fn a_few_liars_are_mismatches_and_not_our_pose() {
    for seed in SEEDS {
        let mut actors = crowd();
        for (k, place) in [(1, [0.0, -50.0]), (4, [0.0, 50.0])] {
            actors[k] = Actor::new(&format!("u-{k}"), move |_| place)
                .claim(move |t| Some(if t < 10.0 { place } else { [place[0] + 9.0, place[1]] }));
        }
        tell(&Story::new(seed, actors)).expect(&[
            (PositionMismatch, Some("u-1"), 10.0, 11.5),
            (PositionMismatch, Some("u-4"), 10.0, 11.5),
        ]);
    }
}

#[test]
fn an_intruder_is_alerted_while_the_pose_is_off() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t >= 20.0).then_some([20.0, 0.0])));
    let mut story = Story::new(2, actors);
    story.shift = Box::new(|t| if t < 10.0 { [0.0, 0.0] } else { [7.0, 3.0] });
    tell(&story).expect(&[
        (PoseInconsistent, None, 10.0, 12.0),
        (UnclaimedEmitter, None, 20.0, 21.0),
    ]);
}

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
