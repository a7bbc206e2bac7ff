//! Frames or claims stop, or are more than there is room for.

use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::Severity;

use crate::hostile::{forged, intrusion};
use crate::stories::{Actor, Expect, Sensor, Story, crowd, tell, tell_with};

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

/// New names at new places all the time, more than there is room for: an eavesdropper who comes meanwhile is alerted, and the alert of the
/// flood comes and goes.
#[test]
fn a_flood_without_room_is_alerted_and_clears() {
    let mut story = intrusion(25);
    story.seconds = 90.0;
    for k in 0..60_000u32 {
        let t = 5.0 + f64::from(k) / 7000.0;
        let u = |m: u64| (u64::from(k).wrapping_mul(m) >> 11) as f64 / (1u64 << 53) as f64 * 240.0 - 120.0;
        let (x, y) = (u(0x9e37_79b9_7f4a_7c15), u(0xd1b5_4a32_d192_ed03));
        story.forged.push((t, forged(&format!("!{k}"), t, x, y)));
    }
    let told = tell_with(&story, false);
    let raised = told.raised();
    let at = |kind| raised.iter().find(|(k, ..)| *k == kind).map(|(.., t)| *t);
    assert!(at(UnclaimedEmitter).is_some_and(|t| t <= 11.0), "{raised:?}");
    assert!(at(ClaimsFlooded).is_some_and(|t| t < 9.0), "{raised:?}");
    let flood = told
        .events
        .iter()
        .rev()
        .find(|e| e.alert.kind == ClaimsFlooded)
        .expect("an event");
    assert_eq!(flood.alert.severity, Severity::Critical);
    assert!(flood.alert.evidence["claims_lost_per_s"].is_number(), "{flood:?}");
    assert!(flood.alert.cleared_at.is_some(), "{flood:?}");
}
