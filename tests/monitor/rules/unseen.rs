//! A user who is claimed and whose beam is not there.

use oapwatch::claims::ClaimState;
use oapwatch::monitor::AlertKind::*;
use oapwatch::monitor::Severity;

use crate::SEEDS;
use crate::hostile::forged;
use crate::stories::{Actor, Expect, Story, crowd, tell, tell_with};

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

/// Neither to hide who is dark nor to blame them: the beam that goes on was somebody else's before.
#[test]
fn an_alerted_stranger_beside_a_user_who_goes_dark_is_not_that_user() {
    for (seed, away) in [(20, 4.0), (21, 7.0), (22, 10.0)] {
        let mut actors = crowd();
        let dark = 20.0..24.0;
        actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(move |t| (!dark.contains(&t)).then_some([-80.0, 50.0]));
        actors.push(Actor::intruder(move |t| (t >= 10.0).then_some([-80.0 + away, 50.0])));
        let told = tell(&Story::new(seed, actors));
        told.expect(&[
            (UnclaimedEmitter, None, 10.0, 11.0),
            (UserUnseen, Some("u-3"), 20.0, 22.5),
        ]);
        assert!(matches!(told.cleared()[..], [(UserUnseen, ..)]), "{:?}", told.cleared());
    }
}

/// A hundred and twenty users who are nowhere, claimed for twenty seconds: some alerts of their own, one for the rest, and one of
/// their own for a user whose beam goes off meanwhile.
#[test]
fn invented_users_share_an_alert_and_bury_no_other() {
    let mut actors = crowd();
    actors[2] = Actor::new("u-2", |_| [80.0, -50.0]).beam(|t| (t < 20.0).then_some([80.0, -50.0]));
    let mut story = Story::new(14, actors);
    story.seconds = 60.0;
    for k in 0..120 {
        let place = [f64::from(k % 20) * 10.0 - 95.0, f64::from(k / 20) * 10.0 - 70.0];
        for t in 10..30 {
            let t = f64::from(t) + 0.003 * f64::from(k);
            story.forged.push((t, forged(&format!("!{k}"), t, place[0], place[1])));
        }
    }
    let told = tell(&story);
    let raised = told.raised();
    assert!(raised.iter().all(|(kind, ..)| *kind == UserUnseen), "{raised:?}");
    let (common, own): (Vec<_>, Vec<_>) = raised.iter().partition(|(_, user, _)| user.is_none());
    assert_eq!(common.len(), 1, "{raised:?}");
    let invented = own.iter().filter(|(_, user, _)| user.as_deref() != Some("u-2"));
    assert_eq!(invented.count(), 10, "{raised:?}");
    let real: Vec<f64> = own
        .iter()
        .filter(|(_, user, _)| user.as_deref() == Some("u-2"))
        .map(|(.., t)| *t)
        .collect();
    // One alert; a claim made after the beam went off is waited for, as ever.
    assert!(matches!(real[..], [t] if (21.0..=22.5).contains(&t)), "{raised:?}");
    // All of them are listed as unseen, and the alert says how many share it.
    let busy = told.reports.iter().max_by_key(|r| r.unseen.len()).expect("reports");
    assert_eq!(busy.unseen.len(), 121);
    let shared = told
        .events
        .iter()
        .rev()
        .find(|e| e.alert.user.is_none())
        .expect("an event");
    // A few of them are claimed where a user's beam passes.
    let sharing = shared.alert.evidence["users_never_seen"].as_u64();
    assert!((100..=110).contains(&sharing.unwrap_or(0)), "{shared:?}");
    assert_eq!(shared.alert.severity, Severity::Critical);
}

/// New names in every claim: the alerts do not grow with the names.
#[test]
fn ever_new_names_raise_a_bounded_number_of_alerts() {
    let mut story = Story::new(15, crowd());
    story.seconds = 60.0;
    for k in 0..400 {
        let t = 5.0 + 0.1 * f64::from(k);
        let name = format!("!{k}");
        let (x, y) = (f64::from(k % 20) * 10.0 - 95.0, f64::from(k / 20) * 10.0 - 95.0);
        story.forged.push((t, forged(&name, t, x, y)));
        let mut over = forged(&name, t + 3.0, x, y);
        over.state = ClaimState::Ended;
        story.forged.push((t + 3.0, over));
    }
    let told = tell_with(&story, false);
    // Ten within a minute, and one for all others.
    assert_eq!(told.raised().len(), 11, "{:?}", told.raised());
}
