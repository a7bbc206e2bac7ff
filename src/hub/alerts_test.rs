//! Each rule of the hub's list on alerts made by hand.

use jiff::Timestamp;
use serde_json::json;

use super::*;

fn name(station: &str) -> StationName {
    StationName {
        site: "harbour".to_owned(),
        station: station.to_owned(),
    }
}

fn told(kind: AlertEventKind, id: &str, alert: AlertKind, user: Option<&str>, x_m: f64) -> AlertEvent {
    let alert = json!({
        "id": id, "kind": alert, "severity": "warning", "state": "open", "raised_at": Timestamp::UNIX_EPOCH,
        "cleared_at": null, "user": user, "x_m": x_m, "y_m": 0.0, "cov_m2": null, "claimed": null, "evidence": {},
        "source": { "kind": "simulator", "frame": 0 },
    });
    AlertEvent::new(kind, serde_json::from_value(alert).unwrap())
}

fn stranger(kind: AlertEventKind, id: &str, x_m: f64) -> AlertEvent {
    told(kind, id, AlertKind::UnclaimedEmitter, None, x_m)
}

const NOBODY: fn(&str) -> bool = |_| false;
const NOWHERE: fn(&StationName, u64) -> Option<[f64; 2]> = |_, _| None;

#[test]
fn one_cause_at_two_stations_is_one_alert_until_both_clear_it() {
    let mut alerts = HubAlerts::default();
    let raised = alerts
        .take(&name("a"), stranger(AlertEventKind::Raised, "1", 0.0), NOBODY, NOWHERE)
        .unwrap();
    assert_eq!(raised.alert.id, "harbour.a.1");
    assert_eq!(raised.alert.station, Some(name("a")));
    let second = alerts.take(&name("b"), stranger(AlertEventKind::Raised, "1", 5.0), NOBODY, NOWHERE);
    let second = second.expect("who reports it is history");
    assert_eq!(
        (second.event, second.alert.id.as_str()),
        (AlertEventKind::Reported, "harbour.a.1"),
        "within ten metres it is the same stranger"
    );
    assert_eq!(second.alert.evidence[REPORTED].as_array().map(Vec::len), Some(2));
    let third = alerts.take(&name("b"), stranger(AlertEventKind::Raised, "2", 50.0), NOBODY, NOWHERE);
    assert_eq!(third.unwrap().alert.id, "harbour.b.2");
    let first = alerts.take(&name("a"), stranger(AlertEventKind::Cleared, "1", 0.0), NOBODY, NOWHERE);
    assert_eq!(first.unwrap().event, AlertEventKind::Reported);
    let cleared = alerts
        .take(&name("b"), stranger(AlertEventKind::Cleared, "1", 5.0), NOBODY, NOWHERE)
        .unwrap();
    assert_eq!(
        (cleared.event, cleared.alert.id.as_str()),
        (AlertEventKind::Cleared, "harbour.a.1")
    );
    assert_eq!(alerts.open_by_kind()[&AlertKind::UnclaimedEmitter], 1);
}

#[test]
fn a_user_whom_another_station_sees_is_not_unseen() {
    let mut alerts = HubAlerts::default();
    let unseen = |kind| told(kind, "1", AlertKind::UserUnseen, Some("u-1"), 0.0);
    let elsewhere = |user: &str| user == "u-1";
    assert!(
        alerts
            .take(&name("a"), unseen(AlertEventKind::Raised), elsewhere, NOWHERE)
            .is_none()
    );
    assert!(
        alerts
            .take(&name("a"), unseen(AlertEventKind::Updated), NOBODY, NOWHERE)
            .is_none()
    );
    assert!(
        alerts
            .take(&name("a"), unseen(AlertEventKind::Cleared), NOBODY, NOWHERE)
            .is_none()
    );
    assert!(
        alerts
            .take(&name("a"), unseen(AlertEventKind::Raised), NOBODY, NOWHERE)
            .is_some()
    );
}

#[test]
fn what_was_acknowledged_at_the_hub_stays_so_when_the_station_updates_it() {
    let mut alerts = HubAlerts::default();
    alerts.take(&name("a"), stranger(AlertEventKind::Raised, "1", 0.0), NOBODY, NOWHERE);
    let note = Acknowledgement {
        at: Timestamp::UNIX_EPOCH,
        by: Some("guard".to_owned()),
        note: None,
        withdrawn: None,
    };
    assert!(alerts.acknowledge("harbour.a.1", note).is_some());
    let updated = alerts
        .take(&name("a"), stranger(AlertEventKind::Updated, "1", 0.0), NOBODY, NOWHERE)
        .unwrap();
    assert_eq!(updated.alert.state, AlertState::Acknowledged);
    assert_eq!(updated.alert.acknowledgement.unwrap().by.as_deref(), Some("guard"));
}

#[test]
fn after_a_restart_the_list_goes_on() {
    let mut alerts = HubAlerts::default();
    let raised = alerts
        .take(&name("a"), stranger(AlertEventKind::Raised, "1", 0.0), NOBODY, NOWHERE)
        .unwrap();
    let lost = alerts
        .raise(
            OwnCause::StationLost(name("b")),
            Finding::default(),
            Timestamp::UNIX_EPOCH,
        )
        .unwrap();
    let mut again = HubAlerts::default();
    again.restore(vec![raised.alert, lost.alert]);
    assert!(
        again
            .raise(
                OwnCause::StationLost(name("b")),
                Finding::default(),
                Timestamp::UNIX_EPOCH
            )
            .is_none()
    );
    assert!(
        again
            .clear(&OwnCause::StationLost(name("b")), Timestamp::UNIX_EPOCH)
            .is_some()
    );
    let cleared = again
        .take(&name("a"), stranger(AlertEventKind::Cleared, "1", 0.0), NOBODY, NOWHERE)
        .unwrap();
    assert_eq!(cleared.alert.id, "harbour.a.1");
    assert!(again.open_by_kind().is_empty());
}

#[test]
fn after_a_restart_it_is_known_who_reports_an_alert() {
    let mut alerts = HubAlerts::default();
    alerts.take(&name("a"), stranger(AlertEventKind::Raised, "1", 0.0), NOBODY, NOWHERE);
    let shared = alerts
        .take(&name("b"), stranger(AlertEventKind::Raised, "1", 5.0), NOBODY, NOWHERE)
        .unwrap();
    // The journal holds the alert as its last event has it.
    let mut again = HubAlerts::default();
    again.restore(vec![shared.alert]);
    let mut clear = |station: &str, x_m| {
        let cleared = again.take(
            &name(station),
            stranger(AlertEventKind::Cleared, "1", x_m),
            NOBODY,
            NOWHERE,
        );
        let event = cleared.unwrap();
        (event.event, event.alert.id)
    };
    let id = "harbour.a.1".to_owned();
    assert_eq!(clear("a", 0.0), (AlertEventKind::Reported, id.clone()));
    assert_eq!(clear("b", 5.0), (AlertEventKind::Cleared, id));
    assert!(again.open_by_kind().is_empty());
}

#[test]
fn evidence_of_any_form_is_taken() {
    for evidence in [json!(null), json!("text"), json!([1, 2]), json!(3)] {
        let mut alerts = HubAlerts::default();
        for station in ["a", "b"] {
            let mut event = stranger(AlertEventKind::Raised, "1", 0.0);
            event.alert.evidence = evidence.clone();
            let taken = alerts.take(&name(station), event, NOBODY, NOWHERE).unwrap();
            assert!(taken.alert.evidence[REPORTED].is_array(), "{evidence}");
        }
    }
}

/// A stranger whom both stations have told of.
fn raised_by_both() -> HubAlerts {
    let mut alerts = HubAlerts::default();
    for station in ["a", "b"] {
        alerts.take(
            &name(station),
            stranger(AlertEventKind::Raised, "1", 0.0),
            NOBODY,
            NOWHERE,
        );
    }
    alerts
}

#[test]
fn an_alert_that_another_station_goes_on_with_stays_the_one_that_was_raised() {
    let mut alerts = raised_by_both();
    let left = alerts.take(&name("a"), stranger(AlertEventKind::Cleared, "1", 0.0), NOBODY, NOWHERE);
    assert_eq!(left.unwrap().alert.station, Some(name("b")));
    let mut worse = stranger(AlertEventKind::Updated, "1", 3.0);
    worse.alert.severity = Severity::Critical;
    worse.alert.raised_at = Timestamp::from_second(5).unwrap();
    let updated = alerts.take(&name("b"), worse, NOBODY, NOWHERE).unwrap().alert;
    assert_eq!(
        (updated.id.as_str(), updated.severity),
        ("harbour.a.1", Severity::Critical)
    );
    assert_eq!((updated.x_m, updated.raised_at), (Some(3.0), Timestamp::UNIX_EPOCH));
    let cleared = alerts.take(&name("b"), stranger(AlertEventKind::Cleared, "1", 3.0), NOBODY, NOWHERE);
    let cleared = cleared.unwrap();
    assert_eq!(
        (cleared.event, cleared.alert.id.as_str()),
        (AlertEventKind::Cleared, "harbour.a.1")
    );
    assert!(alerts.open_by_kind().is_empty());
}

#[test]
fn the_severest_of_the_stations_counts() {
    let mut alerts = raised_by_both();
    let mut second = stranger(AlertEventKind::Updated, "1", 0.0);
    assert!(alerts.take(&name("b"), second.clone(), NOBODY, NOWHERE).is_none());
    second.alert.severity = Severity::Critical;
    let updated = alerts.take(&name("b"), second, NOBODY, NOWHERE).unwrap();
    assert_eq!(updated.alert.severity, Severity::Critical);
    let first = alerts.take(&name("a"), stranger(AlertEventKind::Updated, "1", 0.0), NOBODY, NOWHERE);
    assert_eq!(first.unwrap().alert.severity, Severity::Critical, "it only rises");
}

#[test]
fn a_stranger_who_has_walked_on_is_the_same() {
    let walked = |station: &StationName, track| (*station == name("a") && track == 7).then_some([30.0, 0.0]);
    for (track, is_same) in [(7, true), (8, false)] {
        let mut alerts = HubAlerts::default();
        let mut raised = stranger(AlertEventKind::Raised, "1", 0.0);
        raised.alert.evidence = json!({ "track": track });
        alerts.take(&name("a"), raised, NOBODY, walked);
        let second = alerts.take(&name("b"), stranger(AlertEventKind::Raised, "1", 32.0), NOBODY, walked);
        let expected = if is_same {
            AlertEventKind::Reported
        } else {
            AlertEventKind::Raised
        };
        assert_eq!(second.unwrap().event, expected);
    }
}
