//! Alerts over a restart, and of causes that come and go: what is open goes on, what is over clears, nothing is raised twice.

use oapwatch::monitor::AlertKind::*;

use crate::stories::{Actor, Expect, Story, crowd, tell};

#[test]
fn an_intruder_that_stays_is_still_the_same_alert() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (10.0..25.0).contains(&t).then_some([20.0, 10.0])));
    let mut story = Story::new(1, actors);
    story.restarts_at = Some(15.0);
    let told = tell(&story);
    told.expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
    assert!((25.5..28.0).contains(&told.cleared()[0].2), "{:?}", told.cleared());
}

#[test]
fn a_shadow_within_a_users_spot_is_still_the_same_alert() {
    let mut actors = crowd();
    let victim = |t: f64| [15.0 * (0.06 * t + 1.0).sin(), -50.0 + 15.0 * (0.05 * t + 2.0).cos()];
    actors.push(Actor::intruder(move |t| {
        let [x, y] = victim(t);
        (30.0..60.0).contains(&t).then_some([x + 0.3, y])
    }));
    let mut story = Story::new(2, actors);
    story.seconds = 75.0;
    story.restarts_at = Some(45.0);
    let told = tell(&story);
    told.expect(&[(UnclaimedEmitter, None, 30.5, 38.0)]);
    let cleared = told.cleared();
    assert!(
        cleared.len() == 1 && (60.5..66.0).contains(&cleared[0].2),
        "{cleared:?}"
    );
}

#[test]
fn a_mismatch_and_an_absence_go_on() {
    let mut actors = crowd();
    actors[0] =
        Actor::new("u-0", |_| [-80.0, -50.0]).beam(|t| Some(if t < 10.0 { [-80.0, -50.0] } else { [-80.0, -30.0] }));
    actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(|t| (t < 10.0).then_some([-80.0, 50.0]));
    let mut story = Story::new(3, actors);
    story.restarts_at = Some(15.0);
    let told = tell(&story);
    let mut raised: Vec<_> = told.raised().into_iter().map(|(kind, user, _)| (kind, user)).collect();
    raised.sort();
    assert_eq!(
        raised,
        [(PositionMismatch, Some("u-0".into())), (UserUnseen, Some("u-3".into()))],
        "{}",
        told.ndjson()
    );
    assert!(told.cleared().is_empty(), "{}", told.ndjson());
}

#[test]
fn what_ended_while_nobody_watched_clears() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| (10.0..14.95).contains(&t).then_some([20.0, 10.0])));
    let mut story = Story::new(4, actors);
    story.restarts_at = Some(15.0);
    let told = tell(&story);
    told.expect(&[(UnclaimedEmitter, None, 10.0, 11.0)]);
    // A new run looks for two seconds first.
    assert!((17.5..20.0).contains(&told.cleared()[0].2));
}

/// A beam that blinks is not an alert a blink: what goes out dies down, and the alert counts how often it came back.
#[test]
fn a_beam_that_blinks_does_not_flood() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| {
        (t >= 10.0 && (t - 10.0) % 5.0 < 2.0).then_some([20.0, 10.0])
    }));
    let mut story = Story::new(13, actors);
    story.seconds = 310.0;
    let told = tell(&story);
    let raised = told.raised();
    assert!(raised.iter().all(|(kind, ..)| *kind == UnclaimedEmitter), "{raised:?}");
    // Held for 1, 2, 4 s: the third time it outlasts the three seconds of dark.
    assert_eq!(raised.len(), 3, "{raised:?}");
    let last = &told.events.last().expect("events").alert;
    assert!(last.evidence["recurrences"].as_u64() >= Some(2), "{last:?}");
}
