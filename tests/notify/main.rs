//! Webhooks against real receivers on the loopback address. The worker's clock runs fast where a test spans hours.

mod alertmanager;
mod config;
mod counterparts;
mod disk;
mod exports;
#[path = "../daemon/port.rs"]
mod port;
mod positions;
mod receiver;
mod sapient;
mod sender;
mod trouble;

use axum::http::StatusCode;
use axum::response::IntoResponse;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use jiff::{SignedDuration, Timestamp};
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{AskError, Clock, EndpointState};

use receiver::Receiver;
use sender::{Daemon, KEY, event, life, on_disk, start, until, webhook};

#[tokio::test]
async fn a_delivery_is_signed_and_carries_the_alert_in_both_forms() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let raised = event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter);
    daemon.record(std::slice::from_ref(&raised));
    until(|| receiver.all().len() == 1).await;

    let seen = &receiver.all()[0];
    let json = seen.json();
    let alert = serde_json::to_value(&raised.alert).unwrap();
    assert_eq!(json["type"], "alert.raised");
    assert_eq!(json["timestamp"], "2026-11-21T08:00:00Z");
    assert_eq!(json["data"], alert);
    assert_eq!((&json["event"], &json["alert"]), (&json["type"], &alert));
    assert_eq!(seen.headers["content-type"], "application/json");

    let (id, sent) = (&seen.headers["webhook-id"], &seen.headers["webhook-timestamp"]);
    assert!(id.starts_with("msg_") && !id.contains('.'));
    let age = Timestamp::now().as_second() - sent.parse::<i64>().unwrap();
    assert!((0..=20).contains(&age), "the time of the attempt, not of the event");
    let mut mac = Hmac::<sha2::Sha256>::new_from_slice(KEY).unwrap();
    mac.update(format!("{id}.{sent}.").as_bytes());
    mac.update(&seen.body);
    let expected = format!("v1,{}", BASE64_STANDARD.encode(mac.finalize().into_bytes()));
    assert_eq!(seen.headers["webhook-signature"], expected);

    until(|| daemon.status().queued == 0).await;
    let status = daemon.status();
    assert_eq!(
        (status.sent, status.failed, status.state),
        (1, 0, EndpointState::Working)
    );
    assert_eq!(status.last_error, None);
    daemon.stop().await;
}

#[tokio::test]
async fn an_endpoint_gets_the_kinds_it_asked_for_and_no_acknowledgement() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let mut config = webhook(dir.path(), &receiver.url);
    config.kinds = Some(vec![AlertKind::SensorLost]);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], Clock::wall());
    daemon.record(&life("other"));
    use AlertEventKind::*;
    daemon.record(&[Raised, Acknowledged, Cleared].map(|kind| event(kind, "lost", AlertKind::SensorLost)));
    until(|| receiver.all().len() == 2).await;
    let got = receiver.accepted();
    assert_eq!(
        got,
        [("lost", "alert.raised"), ("lost", "alert.cleared")].map(|(a, b)| (a.to_owned(), b.to_owned()))
    );
    daemon.stop().await;
}

#[tokio::test]
async fn what_was_not_confirmed_goes_out_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let configs = [webhook(dir.path(), &format!("http://{address}/"))];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    daemon.record(&life("a"));
    until(|| daemon.status().state == EndpointState::Failing).await;
    daemon.stop().await;

    let receiver = Receiver::on(tokio::net::TcpListener::bind(address).await.unwrap(), |_, _| {
        StatusCode::OK.into_response()
    });
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| receiver.accepted().len() == 3).await;
    let types: Vec<String> = receiver.accepted().into_iter().map(|(_, t)| t).collect();
    assert_eq!(types, ["alert.raised", "alert.updated", "alert.cleared"]);
    daemon.stop().await;
}

#[tokio::test]
async fn events_are_sent_while_the_disk_refuses_them_and_not_again_after() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let other = rusqlite::Connection::open(dir.path().join("a.db")).unwrap();
    other.execute_batch("BEGIN IMMEDIATE").unwrap();
    daemon.record(&life("a"));
    until(|| receiver.accepted().len() == 3).await;
    assert!(!daemon.journal.health().writable);
    other.execute_batch("ROLLBACK").unwrap();
    until(|| daemon.journal.health().writable && daemon.journal.health().unwritten == 0).await;
    daemon.stop().await;

    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    until(|| daemon.status().sent == 3).await;
    assert_eq!(daemon.status().queued, 0);
    assert_eq!(receiver.all().len(), 3);
    daemon.stop().await;
}

/// A cause that flaps for ten minutes, as the journal has it and as the receiver hears of it.
#[tokio::test]
async fn a_cool_down_tells_the_receiver_once_and_the_history_all() {
    use AlertEventKind::{Cleared, Raised, Updated};
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let mut config = webhook(dir.path(), &receiver.url);
    config.cool_down_s = 3600.0;
    let clock = Clock::fast(start(), 600.0);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], clock);
    for id in ["a", "b", "c"] {
        daemon.record(&[Raised, Cleared].map(|what| event(what, id, AlertKind::UnclaimedEmitter)));
    }
    // Another kind is another cause. The last one stays.
    daemon.record(&[
        event(Raised, "other", AlertKind::SensorLost),
        event(Raised, "stays", AlertKind::UnclaimedEmitter),
    ]);
    // What the receiver has accepted leaves the queue a moment later.
    until(|| daemon.status().withheld == 4 && daemon.status().queued == 1).await;
    assert_eq!(receiver.accepted().len(), 3);
    until(|| daemon.status().queued == 0).await;
    assert!(clock.now() >= start() + SignedDuration::from_hours(1));
    daemon.record(&[event(Updated, "stays", AlertKind::UnclaimedEmitter)]);
    until(|| daemon.status().sent == 5).await;
    let mut heard = receiver.accepted();
    // Different alerts may overtake each other.
    heard.sort();
    let expected = [
        ("a", "alert.cleared"),
        ("a", "alert.raised"),
        ("other", "alert.raised"),
        ("stays", "alert.raised"),
        ("stays", "alert.updated"),
    ];
    assert_eq!(heard, expected.map(|(id, what)| (id.to_owned(), what.to_owned())));
    daemon.journal.settled().await;
    assert_eq!(daemon.journal.events_after(0, 100).unwrap().len(), 9);
    assert!(daemon.journal.waiting(&daemon.status().name, 0).unwrap().is_empty());
    daemon.stop().await;
}

#[tokio::test]
async fn a_test_event_is_signed_marked_and_beside_the_queue() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| [StatusCode::OK, StatusCode::FORBIDDEN][k].into_response()).await;
    let mut config = webhook(dir.path(), &receiver.url);
    config.name = Some("soc".to_owned());
    let clock = Clock::fast(start(), 1000.0);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], clock);
    let outcome = daemon.notifier.test("soc").await.unwrap();
    assert_eq!(
        (outcome.delivered, outcome.status, outcome.error),
        (true, Some(200), None)
    );
    let seen = &receiver.all()[0];
    let json = seen.json();
    assert_eq!(
        (&json["type"], &json["event"]),
        (&"webhook.test".into(), &"webhook.test".into())
    );
    assert_eq!(
        (&json["alert"]["id"], &json["alert"]["evidence"]["test"]),
        (&"test".into(), &true.into())
    );
    let (id, sent) = (&seen.headers["webhook-id"], &seen.headers["webhook-timestamp"]);
    let mut mac = Hmac::<sha2::Sha256>::new_from_slice(KEY).unwrap();
    mac.update(format!("{id}.{sent}.").as_bytes());
    mac.update(&seen.body);
    let expected = format!("v1,{}", BASE64_STANDARD.encode(mac.finalize().into_bytes()));
    assert_eq!(seen.headers["webhook-signature"], expected);

    // What came back is told; nothing is tried again.
    let mut outcome = daemon.notifier.test("soc").await;
    while matches!(outcome, Err(AskError::TooSoon(_))) {
        tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        outcome = daemon.notifier.test("soc").await;
    }
    let outcome = outcome.unwrap();
    assert_eq!((outcome.delivered, outcome.status), (false, Some(403)));
    assert!(outcome.error.is_some_and(|error| error.contains("403")));
    assert_eq!(receiver.all().len(), 2);
    let status = daemon.status();
    assert_eq!((status.sent, status.failed, status.queued), (0, 0, 0));
    assert!(matches!(daemon.notifier.test("other").await, Err(AskError::Unknown(_))));
    daemon.stop().await;
}

#[tokio::test]
async fn an_endpoint_that_stays_keeps_its_queue_and_one_that_goes_leaves_it_in_the_journal() {
    let dir = tempfile::tempdir().unwrap();
    let down = Receiver::start(|_, _| StatusCode::SERVICE_UNAVAILABLE.into_response()).await;
    let up = Receiver::accepting().await;
    let named = |name: &str, url: &str| {
        let mut config = webhook(dir.path(), url);
        config.name = Some(name.to_owned());
        config
    };
    let (stays, goes) = (named("stays", &down.url), named("goes", &down.url));
    let daemon = Daemon::start(&on_disk(dir.path()), &[stays, goes.clone()], Clock::wall());
    daemon.record(&life("a"));
    until(|| {
        daemon
            .notifier
            .status()
            .iter()
            .all(|s| s.queued == 3 && s.last_failure.is_some())
    })
    .await;

    let load = |configs: &[oapwatch::notify::Config]| oapwatch::notify::load(configs).unwrap();
    daemon.notifier.replace(load(&[named("stays", &up.url)])).await.unwrap();
    assert_eq!(daemon.notifier.status().len(), 1);
    assert_eq!(daemon.status().url, up.url);
    daemon.record(&life("b"));
    // The address is another, the delivery's next attempt is not: a new alert goes out beside it.
    until(|| up.accepted().iter().filter(|(id, _)| id == "b").count() == 3).await;
    until(|| up.accepted().iter().filter(|(id, _)| id == "a").count() == 3).await;

    daemon.notifier.replace(load(&[named("goes", &up.url)])).await.unwrap();
    until(|| daemon.status().queued == 0 && daemon.status().sent == 3).await;
    let of_b = up.accepted().iter().filter(|(id, _)| id == "b").count();
    assert_eq!(of_b, 3, "events while it was not configured are not sent to it");
    daemon.stop().await;
}
