//! Whoever writes claims wants an alert not to come.

use std::time::Instant;

use oapwatch::claims::{Claim, ClaimState};
use oapwatch::monitor::AlertKind::{self, *};

use crate::stories::{Actor, Expect, Story, at, crowd, tell, tell_with};

pub fn forged(user: &str, made: f64, x_m: f64, y_m: f64) -> Claim {
    Claim {
        time: at(made),
        user: user.into(),
        x_m,
        y_m,
        z_m: None,
        sigma_m: Some(0.3),
        cov_m2: None,
        power_w: None,
        state: ClaimState::Active,
    }
}

/// Six users and an intruder at (20, 10) from 10 s on.
pub fn intrusion(seed: u64) -> Story {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (t >= 10.0).then_some([20.0, 10.0])));
    let mut story = Story::new(seed, actors);
    story.seconds = 15.0;
    story
}

/// When the first alert of `kind` for `user` came, s.
fn first(story: &Story, kind: AlertKind, user: Option<&str>) -> Option<f64> {
    let raised = tell(story).raised();
    let found = raised.iter().find(|(k, u, _)| *k == kind && u.as_deref() == user);
    found.map(|(_, _, t)| *t)
}

#[test]
fn a_flood_of_invented_users_hides_no_intruder_and_holds_nobody_up() {
    let mut story = intrusion(1);
    for k in 0..5000 {
        let (x, y) = (f64::from(k % 71) * 3.4 - 120.0, f64::from(k / 71) * 3.3 - 117.0);
        // Nobody claims to be where the intruder is: that would be another story.
        if (x - 20.0).hypot(y - 10.0) > 20.0 {
            story.forged.push((9.0, forged(&format!("!{k}"), 9.0, x, y)));
        }
    }
    let began = Instant::now();
    let told = tell_with(&story, false);
    // 60 frames with the flood; slow even for a debug build on a busy machine would be a stall of the product.
    assert!(began.elapsed().as_secs_f64() < 30.0, "{:?}", began.elapsed());
    let found = told
        .raised()
        .iter()
        .any(|(kind, _, t)| *kind == UnclaimedEmitter && *t <= 11.0);
    assert!(found, "{} alerts", told.raised().len());
}

#[test]
fn forged_claims_for_others_raise_alerts_and_stop_none() {
    // Far off, and always a moment newer than the truth.
    let mut story = intrusion(2);
    for k in 0..300 {
        let t = 0.05 * f64::from(k);
        story.forged.push((t, forged("u-2", t, 80.0, 100.0)));
    }
    assert!(first(&story, UnclaimedEmitter, None).is_some_and(|t| t <= 11.0));
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some());
}

#[test]
fn claims_from_the_future_the_past_and_the_ends_of_the_world_change_nothing() {
    let mut story = intrusion(3);
    for k in 0..200 {
        let t = 0.07 * f64::from(k);
        story.forged.push((t, forged("u-2", t + 1e6, 0.0, 0.0)));
        story.forged.push((t, forged("u-2", t - 1e6, 0.0, 0.0)));
        story.forged.push((t, forged(&"x".repeat(256), t, 1e7, -1e7)));
        let mut odd = forged("odd", t, f64::NAN, f64::INFINITY);
        odd.sigma_m = Some(f64::NAN);
        story.forged.push((t, odd));
    }
    tell(&story).expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
}

/// A stated error of a kilometre must not make a lie about the place pass, nor a claim that is repeated count twice.
#[test]
fn a_huge_sigma_and_repeated_claims_hide_no_lie() {
    let mut story = Story::new(4, crowd());
    story.seconds = 40.0;
    story.actors[2] =
        Actor::new("u-2", |_| [60.0, -50.0]).claim(|t| Some(if t < 10.0 { [60.0, -50.0] } else { [100.0, -50.0] }));
    story.actors[2].sigma_m = 0.3;
    let mut lies: Vec<(f64, Claim)> = Vec::new();
    for k in 0..300 {
        let t = 10.0 + 0.1 * f64::from(k);
        let mut claim = forged("u-2", t, 100.0, -50.0);
        claim.sigma_m = Some(1000.0);
        lies.extend([(t, claim.clone()), (t, claim.clone()), (t, claim)]);
    }
    story.forged = lies;
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some_and(|t| t <= 14.0));
}

/// Claims that end and start again at every turn neither hide the beam nor shake an alert off.
#[test]
fn a_session_that_ends_all_the_time_hides_no_lie() {
    let mut story = Story::new(5, crowd());
    story.seconds = 40.0;
    story.actors[2] = Actor::new("u-2", |_| [60.0, -50.0]).claim(|t| (t < 10.0).then_some([60.0, -50.0]));
    for k in 0..120 {
        let t = 10.0 + 0.25 * f64::from(k);
        let mut claim = forged("u-2", t, 100.0, -50.0);
        if k % 2 == 1 {
            claim.state = ClaimState::Ended;
        }
        story.forged.push((t, claim));
    }
    let raised = tell(&story).raised();
    assert!(
        raised
            .iter()
            .any(|(kind, _, t)| matches!(kind, PositionMismatch | UnclaimedEmitter) && *t <= 16.0),
        "{raised:?}"
    );
}

/// Fewer than a third of the users lie together to shift our own pose.
#[test]
fn liars_in_league_do_not_move_our_pose() {
    let mut actors = crowd();
    actors.push(Actor::new("u-6", |_| [40.0, 0.0]));
    for (k, place) in [(1, [0.0, -50.0]), (4, [0.0, 50.0])] {
        actors[k] = Actor::new(&format!("u-{k}"), move |_| place).claim(move |t| {
            let lie = 0.3 * (t - 10.0).max(0.0);
            Some([place[0] + lie, place[1]])
        });
    }
    let mut story = Story::new(6, actors);
    story.seconds = 60.0;
    let told = tell(&story);
    let mut who: Vec<_> = told.raised().into_iter().map(|(kind, user, _)| (kind, user)).collect();
    who.sort();
    assert_eq!(
        who,
        [
            (PositionMismatch, Some("u-1".into())),
            (PositionMismatch, Some("u-4".into()))
        ],
        "{}",
        told.ndjson()
    );
}

/// Two of seven lie as if we were turned by three degrees; being far out makes their lies large.
#[test]
fn liars_in_league_do_not_turn_us() {
    let mut actors = crowd();
    actors.push(Actor::new("u-6", |_| [40.0, 0.0]));
    for (k, place) in [(0, [-90.0, -60.0]), (5, [90.0, 60.0])] {
        actors[k] = Actor::new(&format!("u-{k}"), move |_| place).claim(move |t| {
            let turn = 0.15 * ((t - 10.0) / 40.0).clamp(0.0, 1.0);
            Some([place[0] + turn * place[1], place[1] - turn * place[0]])
        });
    }
    let mut story = Story::new(7, actors);
    story.seconds = 60.0;
    let told = tell(&story);
    let mut who: Vec<_> = told.raised().into_iter().map(|(kind, user, _)| (kind, user)).collect();
    who.sort();
    let expected = ["u-0", "u-5"].map(|u| (PositionMismatch, Some(u.to_owned())));
    assert_eq!(who, expected, "{}", told.ndjson());
}

/// A user goes off the air without a word. Their last claim is nobody's licence to appear near it.
#[test]
fn a_silent_users_old_claim_covers_for_no_stranger() {
    let mut actors = crowd();
    let there = |t: f64| (t < 10.0).then_some([80.0, -50.0]);
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(there).claim(there);
    actors.push(Actor::intruder(|t| (t >= 22.0).then_some([60.0, -20.0])));
    let told = tell(&Story::new(8, actors));
    let found = told.raised().into_iter().find(|(kind, ..)| *kind == UnclaimedEmitter);
    assert!(
        found.is_some_and(|(_, _, t)| (22.0..=23.0).contains(&t)),
        "{}",
        told.ndjson()
    );
}

/// Claims that were true once are sent again, with their old times and with new ones.
#[test]
fn replayed_claims_hide_no_lie() {
    let mut story = Story::new(9, crowd());
    story.actors[2] = Actor::new("u-2", |_| [80.0, -50.0])
        .beam(|t| Some(if t < 10.0 { [80.0, -50.0] } else { [80.0, -35.0] }))
        .claim(|t| (t < 10.0).then_some([80.0, -50.0]));
    for k in 0..100 {
        let t = 10.0 + 0.2 * f64::from(k);
        story
            .forged
            .push((t, forged("u-2", 9.0 - 0.1 * f64::from(k % 20), 80.0, -50.0)));
        story.forged.push((t, forged("u-2", t, 80.0, -50.0)));
    }
    assert!(first(&story, PositionMismatch, Some("u-2")).is_some_and(|t| t <= 11.0));
}
