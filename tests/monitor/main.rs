//! The monitor held to stories: what it must raise, when, and that it raises nothing else.

mod hostile;
mod pose;
mod restart;
#[path = "../stories/mod.rs"]
mod stories;

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::PositionStatus;
use stories::{Actor, Sensor, Story, crowd, tell};

const SEEDS: std::ops::Range<u64> = 0..5;

#[test]
fn an_honest_crowd_raises_nothing_and_is_verified() {
    for seed in SEEDS {
        let told = tell(&Story::new(seed, crowd()));
        told.expect(&[]);
        let last = told.reports.last().unwrap();
        assert_eq!(last.emitters.len(), 6);
        assert!(
            last.emitters.iter().all(|e| e.status == PositionStatus::Verified),
            "{last:?}"
        );
    }
}

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
fn a_user_that_goes_dark_is_unseen() {
    for seed in SEEDS {
        let mut actors = crowd();
        actors[3] =
            Actor::new("u-3", |_| [-80.0, 50.0]).beam(|t| (!(10.0..20.0).contains(&t)).then_some([-80.0, 50.0]));
        let told = tell(&Story::new(seed, actors));
        told.expect(&[(UserUnseen, Some("u-3"), 10.0, 12.5)]);
        assert!((20.0..22.0).contains(&told.cleared()[0].2));
    }
}

#[test]
fn an_unseen_user_and_a_later_intruder_are_two_causes() {
    let mut actors = crowd();
    actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(|t| (t < 10.0).then_some([-80.0, 50.0]));
    actors.push(Actor::intruder(|t| (t >= 15.0).then_some([20.0, 0.0])));
    tell(&Story::new(5, actors)).expect(&[
        (UserUnseen, Some("u-3"), 10.0, 12.5),
        (UnclaimedEmitter, None, 15.0, 16.0),
    ]);
}

#[test]
fn users_that_end_or_leave_the_view_raise_nothing() {
    let mut actors = crowd();
    actors[1] = Actor::new("u-1", |_| [0.0, -50.0]).beam(|t| (t < 12.4).then_some([0.0, -50.0]));
    actors[1].ended_at = Some(12.0);
    actors.push(Actor::new("u-7", |t| [100.0 + 2.0 * t, 20.0]));
    actors.push(Actor::new("u-8", |t| [-160.0 + 3.0 * t, 10.0]));
    tell(&Story::new(6, actors)).expect(&[]);
}

#[test]
fn a_beam_that_stays_after_its_claim_ended_is_unclaimed() {
    let mut actors = crowd();
    actors[1] = Actor::new("u-1", |_| [0.0, -50.0]);
    actors[1].ended_at = Some(12.0);
    tell(&Story::new(7, actors)).expect(&[(UnclaimedEmitter, None, 12.5, 17.0)]);
}

#[test]
fn crossing_users_raise_nothing() {
    for seed in 0..20 {
        let speed = 0.7 + 0.1 * seed as f64;
        let offset = 0.15 * seed as f64;
        let actors = vec![
            Actor::new("a", move |t| [-15.0 * speed + speed * t, 0.0]),
            Actor::new("b", move |t| [15.0 * speed - speed * t, offset]),
            Actor::new("c", |_| [60.0, 60.0]),
        ];
        tell(&Story::new(seed, actors)).expect(&[]);
    }
}

#[test]
fn users_walking_together_raise_nothing() {
    let actors = vec![
        Actor::new("a", |t| [t, 0.0]),
        Actor::new("b", |t| [t + 1.0 + (0.3 * t).sin(), 0.3]),
        Actor::new("c", |_| [60.0, 60.0]),
    ];
    tell(&Story::new(2, actors)).expect(&[]);
}

#[test]
fn a_blinded_sensor_is_one_alert() {
    for kind in [
        Sensor::Nan,
        Sensor::Zero,
        Sensor::Saturated,
        Sensor::Frozen,
        Sensor::Nothing,
        Sensor::LensCap,
    ] {
        let mut story = Story::new(8, crowd());
        story.sensor = Box::new(move |t| if (10.0..15.0).contains(&t) { kind } else { Sensor::Fine });
        let told = tell(&story);
        told.expect(&[(SensorLost, None, 10.5, 12.0)]);
        let cleared = told.cleared();
        assert!((15.0..16.5).contains(&cleared[0].2), "{cleared:?}");
    }
}

#[test]
fn claims_that_stop_are_one_alert() {
    let mut story = Story::new(9, crowd());
    story.seconds = 60.0;
    story.delivery = Box::new(|t| (!(10.0..40.0).contains(&t)).then_some(t));
    let told = tell(&story);
    told.expect(&[(ClaimsStale, None, 12.0, 20.0)]);
    assert!((40.0..42.0).contains(&told.cleared()[0].2));
}

#[test]
fn an_intruder_is_alerted_while_claims_are_stale() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t >= 20.0).then_some([20.0, 0.0])));
    let mut story = Story::new(9, actors);
    story.delivery = Box::new(|t| (t < 10.0).then_some(t));
    tell(&story).expect(&[(ClaimsStale, None, 12.0, 20.0), (UnclaimedEmitter, None, 20.0, 21.0)]);
}

#[test]
fn late_claims_raise_nothing() {
    for delay in [0.3, 0.8, 2.0] {
        let mut story = Story::new(10, crowd());
        story.delivery = Box::new(move |t| Some(t + delay * (1.0 + (7.0 * t).sin()) / 2.0));
        tell(&story).expect(&[]);
    }
}

#[test]
fn claims_without_sigma_and_at_other_paces_raise_nothing() {
    for period in [0.1, 0.5, 2.0, 5.0] {
        let mut actors = crowd();
        for actor in &mut actors {
            actor.period_s = period;
            actor.phase_s *= period;
            actor.states_sigma = false;
        }
        let mut story = Story::new(11, actors);
        story.seconds = 60.0;
        tell(&story).expect(&[]);
    }
}

#[test]
fn the_same_story_gives_the_same_bytes() {
    let story = || {
        let mut actors = crowd();
        actors.push(Actor::intruder(|t| (t >= 10.0).then_some([20.0, 10.0])));
        actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(|t| (t < 10.0).then_some([-80.0, 50.0]));
        Story::new(12, actors)
    };
    let (one, other) = (tell(&story()).ndjson(), tell(&story()).ndjson());
    assert!(!one.is_empty());
    assert_eq!(one, other);
}

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

/// Somebody holds one user's claims back while their beam stays on.
#[test]
fn a_user_whose_claims_stop_alone_is_one_stale_alert() {
    let mut actors = crowd();
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).claim(|t| (!(10.0..40.0).contains(&t)).then_some([80.0, -50.0]));
    let mut story = Story::new(9, actors);
    story.seconds = 60.0;
    let told = tell(&story);
    told.expect(&[(ClaimsStale, Some("u-2"), 28.0, 32.0)]);
    assert!((40.0..42.5).contains(&told.cleared()[0].2));
}

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
