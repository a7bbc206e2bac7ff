//! What an Alertmanager gets.

use axum::http::StatusCode;
use axum::response::IntoResponse;
use oapwatch::monitor::{AlertEventKind, AlertKind, Severity};
use oapwatch::notify::Clock;
use serde_json::Value;

use super::exports::{context, load};
use super::receiver::Receiver;
use super::sender::{Daemon, event, on_disk, start, until};

/// What an Alertmanager was sent: (labels, has ended).
fn posted(receiver: &Receiver) -> Vec<Vec<(Value, bool)>> {
    let ended = |alert: &Value| {
        let at = |key: &str| alert[key].as_str().unwrap().parse::<jiff::Timestamp>().unwrap();
        assert!(at("startsAt") <= at("endsAt"));
        at("endsAt") <= jiff::Timestamp::now()
    };
    let alerts = |json: Value| {
        let alerts = json.as_array().unwrap().clone();
        alerts.iter().map(|a| (a["labels"].clone(), ended(a))).collect()
    };
    receiver.all().iter().map(|seen| alerts(seen.json())).collect()
}

#[tokio::test]
async fn alertmanager_gets_labels_that_group_and_the_end_of_what_is_over() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_, _| StatusCode::OK.into_response()).await;
    let token = dir.path().join("token");
    std::fs::write(&token, "hunter2\n").unwrap();
    let base = receiver.url.trim_end_matches("/hook");
    let lines = format!("kind = \"alertmanager\"\nstation = \"ap7\"\ntoken_file = {token:?}\naddress = \"{base}/am/\"");
    let loaded = load(&lines).unwrap();
    let daemon = Daemon::sending_to(&on_disk(dir.path()), vec![loaded.endpoint], Clock::wall());
    let mut raised = event(AlertEventKind::Raised, "a", AlertKind::PositionMismatch);
    raised.alert.user = Some("u-17".to_owned());
    raised.alert.severity = Severity::Warning;
    daemon.record(std::slice::from_ref(&raised));
    until(|| receiver.all().len() == 1).await;
    let seen = &receiver.all()[0];
    assert_eq!(seen.headers["authorization"], "Bearer hunter2");
    assert_eq!(seen.headers["content-type"], "application/json");
    let labels = |severity: &str| {
        serde_json::json!({
            "alertname": "OapwatchPositionMismatch", "job": "oapwatch", "instance": "ap7", "severity": severity,
            "alert_id": "a", "user": "u-17",
        })
    };
    assert_eq!(posted(&receiver)[0], [(labels("warning"), false)]);
    assert_eq!(seen.json()[0]["startsAt"], start().to_string());
    assert_eq!(
        seen.json()[0]["annotations"]["summary"],
        "position mismatch: user u-17 at x 1.50 m, y -2.50 m"
    );

    let mut updated = raised.clone();
    updated.event = AlertEventKind::Updated;
    updated.alert.severity = Severity::Critical;
    daemon.record(std::slice::from_ref(&updated));
    until(|| receiver.all().len() == 2).await;
    let expected = [
        (labels("info"), true),
        (labels("warning"), true),
        (labels("critical"), false),
    ];
    assert_eq!(posted(&receiver)[1], expected);

    // A restarted Alertmanager knows nothing: what is open is sent again.
    let updates = loaded.updates.unwrap();
    let context = context(&daemon);
    updates.round(&context).await.unwrap();
    until(|| receiver.all().len() == 3).await;
    assert_eq!(posted(&receiver)[2], [(labels("critical"), false)]);

    let mut cleared = updated;
    cleared.event = AlertEventKind::Cleared;
    cleared.alert.state = oapwatch::monitor::AlertState::Cleared;
    cleared.alert.cleared_at = Some(start());
    daemon.record(&[cleared]);
    until(|| receiver.all().len() == 4).await;
    assert_eq!(posted(&receiver)[3], [(labels("critical"), true)]);

    let outcome = daemon.notifier.test(&daemon.status().name).await.unwrap();
    assert_eq!((outcome.delivered, outcome.status), (true, Some(200)));
    let test = &posted(&receiver)[4][0];
    assert_eq!((&test.0["alertname"], test.1), (&"OapwatchTest".into(), false));
    daemon.stop().await;
}
