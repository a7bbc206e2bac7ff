//! An alert from raise to clear, over absences, renames and restarts.

use jiff::SignedDuration;
use serde_json::json;

use super::*;
use crate::monitor::alert::Severity;

fn at(s: f64) -> Timestamp {
    Timestamp::from_second(1000).unwrap() + SignedDuration::from_secs_f64(s)
}

fn lifecycle() -> AlertLifecycle {
    AlertLifecycle::new("replay".into(), None, 60.0)
}

fn unseen(user: &str) -> Cause {
    Cause::User(AlertKind::UserUnseen, user.into())
}

fn present(cause: &Cause, severity: Severity) -> Finding {
    Finding::present(cause.clone(), Content::new(severity, json!({ "n": 1 })))
}

fn at_place(track: u64, x: f64) -> Finding {
    let content = Content::new(Severity::Warning, json!({}));
    let place = nalgebra::Vector3::new(x, 0.0, 0.0);
    Finding::present(Cause::Track(track), content.at(place, Default::default()))
}

/// Applies a finding and gives the kinds of the events.
fn apply(alerts: &mut AlertLifecycle, finding: Finding, s: f64) -> Vec<AlertEventKind> {
    alerts.apply(vec![finding], at(s), 7);
    alerts.take_events().into_iter().map(|e| e.event).collect()
}

/// The cause is absent every 0.1 s from `from` until its alert clears; gives when.
fn clears(alerts: &mut AlertLifecycle, cause: &Cause, from: f64) -> f64 {
    (0..1000)
        .map(|k| from + 0.1 * f64::from(k))
        .find(|s| !apply(alerts, Finding::Absent(cause.clone()), *s).is_empty())
        .expect("it clears")
}

use AlertEventKind::*;

#[test]
fn a_cause_is_one_alert_from_raise_to_clear() {
    let (mut alerts, cause) = (lifecycle(), unseen("a"));
    assert_eq!(apply(&mut alerts, present(&cause, Severity::Warning), 0.0), [Raised]);
    assert_eq!(alerts.raised_at(&cause), Some(at(0.0)));
    assert_eq!(apply(&mut alerts, present(&cause, Severity::Warning), 1.0), []);
    assert_eq!(apply(&mut alerts, present(&cause, Severity::Critical), 2.0), [Updated]);
    // It never becomes milder.
    assert_eq!(apply(&mut alerts, present(&cause, Severity::Warning), 3.0), []);
    assert_eq!(alerts.open().next().unwrap().1.severity, Severity::Critical);
    assert_eq!(apply(&mut alerts, Finding::Absent(cause.clone()), 4.0), []);
    assert_eq!(apply(&mut alerts, Finding::Absent(cause.clone()), 4.9), []);
    assert_eq!(apply(&mut alerts, Finding::Absent(cause.clone()), 5.0), [Cleared]);
    assert!(!alerts.is_open(&cause));
    assert_eq!(apply(&mut alerts, Finding::Absent(cause), 6.0), []);
}

#[test]
fn a_cause_that_comes_back_is_held_open_for_twice_as_long_each_time() {
    let (mut alerts, cause) = (lifecycle(), unseen("a"));
    let mut now = 0.0;
    for hold in [1.0, 2.0, 4.0, 8.0] {
        apply(&mut alerts, present(&cause, Severity::Warning), now);
        let cleared = clears(&mut alerts, &cause, now + 0.1);
        assert!(
            (cleared - now - 0.1 - hold).abs() < 0.11,
            "{hold}: {cleared} after {now}"
        );
        now = cleared + 1.0;
    }
    // After the cool-down it is a new cause.
    now += 61.0;
    apply(&mut alerts, present(&cause, Severity::Warning), now);
    assert!((clears(&mut alerts, &cause, now) - now - 1.0).abs() < 0.11);
}

#[test]
fn a_cause_that_comes_back_from_half_of_what_clears_it_counts_as_a_recurrence() {
    let (mut alerts, cause) = (lifecycle(), unseen("a"));
    apply(&mut alerts, present(&cause, Severity::Warning), 0.0);
    for (absent, back, recurrences) in [(1.0, 1.4, None), (2.0, 2.6, Some(1))] {
        apply(&mut alerts, Finding::Absent(cause.clone()), absent);
        apply(&mut alerts, present(&cause, Severity::Warning), back);
        let alert = alerts.open().next().unwrap().1;
        assert_eq!(alert.evidence["recurrences"].as_u64(), recurrences);
    }
}

#[test]
fn a_renamed_cause_keeps_its_alert() {
    let mut alerts = lifecycle();
    apply(&mut alerts, at_place(1, 0.0), 0.0);
    let renamed = Finding::Renamed {
        from: Cause::Track(1),
        to: Cause::CoLocated("a".into()),
    };
    assert_eq!(apply(&mut alerts, renamed, 1.0), []);
    assert!(!alerts.is_open(&Cause::Track(1)));
    assert_eq!(alerts.raised_at(&Cause::CoLocated("a".into())), Some(at(0.0)));
    assert!(alerts.concerns("a") && !alerts.concerns("b"));
}

#[test]
fn a_restored_alert_is_cleared_only_by_a_run_that_has_caught_up() {
    let (mut before, cause) = (lifecycle(), unseen("a"));
    apply(&mut before, present(&cause, Severity::Warning), 0.0);
    apply(&mut before, at_place(1, 0.0), 0.0);
    let mut alerts = lifecycle();
    for alert in before.start_again() {
        alerts.restore(alert, || 99);
    }
    assert!(alerts.is_open(&cause) && alerts.is_open(&Cause::Track(99)));
    for k in 0..50 {
        assert_eq!(
            apply(&mut alerts, Finding::Absent(cause.clone()), 10.0 + f64::from(k)),
            []
        );
    }
    alerts.catch_up(true);
    assert!((clears(&mut alerts, &cause, 60.0) - 61.0).abs() < 0.11);
}

#[test]
fn users_without_a_claim_are_absent_and_beams_are_not() {
    let mut alerts = lifecycle();
    for finding in [
        present(&unseen("a"), Severity::Warning),
        present(&unseen("b"), Severity::Warning),
        at_place(1, 0.0),
    ] {
        apply(&mut alerts, finding, 0.0);
    }
    for s in [1.0, 2.0] {
        alerts.absent_without_claim(|user| user == "b", at(s));
    }
    let open: Vec<_> = alerts.open().map(|(cause, _)| cause.clone()).collect();
    assert_eq!(open, [unseen("b"), Cause::Track(1)]);
}

#[test]
fn users_count_as_alerted_lately_for_the_cool_down() {
    let mut alerts = lifecycle();
    for user in ["a", "b"] {
        apply(&mut alerts, present(&unseen(user), Severity::Warning), 0.0);
    }
    let cleared = clears(&mut alerts, &unseen("a"), 1.0);
    let lately = |s: f64| alerts.users_lately_with(AlertKind::UserUnseen, at(s)).len();
    assert_eq!((lately(cleared + 59.0), lately(cleared + 61.0)), (2, 1));
    assert_eq!(
        alerts.users_with(AlertKind::UserUnseen).into_iter().collect::<Vec<_>>(),
        ["b"]
    );
}

#[test]
fn an_acknowledgement_and_its_withdrawal_are_events_of_an_open_alert() {
    let mut alerts = lifecycle();
    apply(&mut alerts, present(&unseen("a"), Severity::Warning), 0.0);
    let id = alerts.open().next().unwrap().1.id.clone();
    let acknowledgement = || Acknowledgement {
        at: at(1.0),
        by: None,
        note: None,
        withdrawn: None,
    };
    let withdrawal = || Withdrawal { at: at(2.0), by: None };
    assert!(alerts.unacknowledge(&id, withdrawal()).is_none());
    assert_eq!(alerts.acknowledge(&id, acknowledgement()).unwrap().event, Acknowledged);
    assert!(alerts.acknowledge("none", acknowledgement()).is_none());
    assert_eq!(alerts.unacknowledge(&id, withdrawal()).unwrap().event, Unacknowledged);
}

#[test]
fn what_stands_when_maintenance_ends_is_raised_to_receivers_once() {
    let (mut alerts, cause) = (lifecycle(), unseen("a"));
    let mut told = |maintenance: Option<&str>, s: f64| {
        let mut content = Content::new(Severity::Warning, json!({}));
        content.maintenance = maintenance.map(str::to_owned);
        alerts.apply(vec![Finding::present(cause.clone(), content)], at(s), 7);
        let events = alerts.take_events();
        events.iter().map(|e| (e.event, e.told_as())).collect::<Vec<_>>()
    };
    assert_eq!(told(Some("mast"), 0.0), [(Raised, Raised)]);
    assert_eq!(told(Some("mast"), 1.0), []);
    assert_eq!(told(None, 2.0), [(Updated, Raised)]);
    assert_eq!(told(None, 3.0), []);
}
