//! A user who is not where the log says.

use oapwatch::monitor::AlertKind::*;

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, crowd, tell};

#[test]
fn a_user_that_drifts_away_is_one_mismatch() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(|t| Some([80.0, -50.0 + (t - 10.0).max(0.0)]));
        // 5 m beyond tolerance at 20 s, at 1 m/s.
        tell(&Story::new(seed, actors)).expect(&[(PositionMismatch, Some("u-2"), 15.0, 18.0)]);
    }
}

#[test]
fn a_slow_drift_is_caught_before_it_is_a_metre_beyond() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(|t| Some([80.0, -50.0 + 0.1 * (t - 10.0).max(0.0)]));
        let mut story = Story::new(seed, actors);
        story.seconds = 80.0;
        // 5 m at 60 s, 6 m at 70 s.
        story.actors[2].sigma_m = 0.1;
        tell(&story).expect(&[(PositionMismatch, Some("u-2"), 60.0, 70.0)]);
    }
}

#[test]
fn a_jump_is_one_mismatch_whatever_its_length() {
    for (seed, length) in [8.0, 14.0, 20.0, 45.0, 120.0].into_iter().enumerate() {
        let mut actors = crowd();
        actors[0] = Actor::new("u-0", |_| [-80.0, -50.0]).beam(move |t| {
            Some(if t < 10.25 {
                [-80.0, -50.0]
            } else {
                [-80.0, -50.0 + length]
            })
        });
        tell(&Story::new(seed as u64, actors)).expect(&[(PositionMismatch, Some("u-0"), 10.25, 11.5)]);
    }
}

#[test]
fn a_claim_that_jumps_is_a_mismatch_too() {
    let mut actors = crowd();
    actors[0] =
        Actor::new("u-0", |_| [-80.0, -50.0]).claim(|t| Some(if t < 10.0 { [-80.0, -50.0] } else { [-80.0, 0.0] }));
    tell(&Story::new(1, actors)).expect(&[(PositionMismatch, Some("u-0"), 10.0, 12.0)]);
}

#[test]
fn a_mismatch_clears_when_the_user_is_back() {
    let mut actors = crowd();
    actors[0] = Actor::new("u-0", |_| [-80.0, -50.0]).beam(|t| {
        Some(if (10.0..15.0).contains(&t) {
            [-80.0, -38.0]
        } else {
            [-80.0, -50.0]
        })
    });
    let told = tell(&Story::new(3, actors));
    told.expect(&[(PositionMismatch, Some("u-0"), 10.0, 11.5)]);
    let cleared = told.cleared();
    assert_eq!(cleared.len(), 1);
    assert!((15.0..19.0).contains(&cleared[0].2), "{cleared:?}");
}

#[test]
fn an_absent_users_claim_answered_from_elsewhere_is_a_mismatch() {
    let mut actors = crowd();
    actors.push(
        Actor::new("u-9", |_| [40.0, 0.0])
            .claim(|t| (t >= 10.0).then_some([40.0, 0.0]))
            .beam(|t| (t >= 10.0).then_some([-40.0, 5.0])),
    );
    tell(&Story::new(4, actors)).expect(&[(PositionMismatch, Some("u-9"), 10.0, 12.0)]);
}

#[test]
fn light_that_does_not_fit_the_reported_power_is_evidence() {
    let mut actors = crowd();
    // u-1 reports half of the others' power and sends it; who answers u-0's claim from 20 m off is a sixth as bright as u-0 reports.
    actors.iter_mut().for_each(|a| a.reports_w = Some(1.0));
    actors[1].reports_w = Some(0.5);
    actors[1].energy_j *= 0.5;
    actors[0] =
        Actor::new("u-0", |_| [-80.0, -50.0]).beam(|t| Some(if t < 10.0 { [-80.0, -50.0] } else { [-80.0, -30.0] }));
    actors[0].reports_w = Some(6.0);
    let mut story = Story::new(3, actors);
    story.seconds = 15.0;
    let told = tell(&story);
    let alert = &told.events[0].alert;
    assert_eq!((alert.kind, alert.user.as_deref()), (PositionMismatch, Some("u-0")));
    let power = &alert.evidence["power_against_reported"];
    assert_eq!(power["reported_w"], 6.0);
    let ratio = power["ratio"].as_f64().unwrap();
    assert!((0.08..0.35).contains(&ratio), "{ratio}");
    assert!(power["likelihood_ratio"].as_f64().unwrap() > 10.0, "{power}");
}
