//! A beam nobody claims.

use oapwatch::monitor::AlertKind::*;

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, crowd, tell};

#[test]
fn an_intruder_is_alerted_within_a_second_and_cleared_when_gone() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.push(Actor::intruder(|t| {
            (10.0..20.0).contains(&t).then_some([20.0 + t, 10.0])
        }));
        let told = tell(&Story::new(seed, actors));
        told.expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
        let cleared = told.cleared();
        assert_eq!(cleared.len(), 1);
        assert!((20.5..22.5).contains(&cleared[0].2), "{cleared:?}");
    }
}

#[test]
fn an_intruder_beside_a_user_is_alerted() {
    for seed in SEEDS {
        let mut actors = crowd();
        let victim = |t: f64| [15.0 * (0.06 * t + 1.0).sin(), -50.0 + 15.0 * (0.05 * t + 2.0).cos()];
        actors.push(Actor::intruder(move |t| {
            let [x, y] = victim(t);
            (t >= 10.0).then_some([x + 2.5, y])
        }));
        tell(&Story::new(seed, actors)).expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
    }
}

#[test]
fn an_intruder_from_the_start_is_alerted_once_claims_have_settled() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors.push(Actor::intruder(|_| Some([20.0, 10.0])));
        tell(&Story::new(seed, actors)).expect(&[(UnclaimedEmitter, None, 0.5, 2.0)]);
    }
}

#[test]
fn a_beam_that_stays_after_its_claim_ended_is_unclaimed() {
    let mut actors = crowd();
    actors[1] = Actor::new("u-1", |_| [0.0, -50.0]);
    actors[1].ended_at = Some(12.0);
    tell(&Story::new(7, actors)).expect(&[(UnclaimedEmitter, None, 12.5, 17.0)]);
}

#[test]
fn who_shines_in_the_pauses_of_a_user_in_bursts_is_a_stranger() {
    for (seed, away) in [(13, 4.0), (14, 7.0), (15, 10.0)] {
        let mut actors = crowd();
        let is_on = |t: f64| (2.0 * t) as i64 % 2 == 0;
        actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(move |t| is_on(t).then_some([-80.0, 50.0]));
        actors.push(Actor::intruder(move |t| {
            (t >= 20.0 && !is_on(t)).then_some([-80.0 + away, 50.0])
        }));
        tell(&Story::new(seed, actors)).expect(&[(UnclaimedEmitter, None, 20.0, 25.0)]);
    }
}

/// At the edge where a user walks out of view: the user's claims go on, the stranger stays.
#[test]
fn a_stranger_where_a_user_left_the_view_is_not_that_user() {
    for (seed, from_s) in [(16, 10.0), (17, 30.0)] {
        let mut actors = crowd();
        // The edge is at 125 m, and passed after 26 s.
        actors[3] = Actor::new("u-3", |t| [88.0 + 1.4 * t, 20.0]);
        actors.push(Actor::intruder(move |t| (t >= from_s).then_some([122.0, 20.0])));
        let mut story = Story::new(seed, actors);
        story.seconds = 60.0;
        let told = tell(&story);
        told.expect(&[(UnclaimedEmitter, None, from_s, from_s + 2.0)]);
        assert!(told.cleared().is_empty(), "{:?}", told.cleared());
    }
}

/// Step by step with a user, never near enough to share the spot for long, never claimed.
#[test]
fn an_eavesdropper_that_follows_a_user_is_one_alert() {
    for (seed, away) in [(10, 2.0), (11, 4.0), (12, 8.0)] {
        let mut actors = crowd();
        let victim = |t: f64| [15.0 * (0.06 * t + 1.0).sin(), -50.0 + 15.0 * (0.05 * t + 2.0).cos()];
        actors.push(Actor::intruder(move |t| {
            let [x, y] = victim((t - 1.0).max(0.0));
            (t >= 10.0).then_some([x + away * (0.2 * t).cos(), y + away * (0.2 * t).sin()])
        }));
        let mut story = Story::new(seed, actors);
        story.seconds = 60.0;
        tell(&story).expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
    }
}
