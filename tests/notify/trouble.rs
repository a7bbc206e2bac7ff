//! Receivers that are down, slow, lying or gone.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use jiff::SignedDuration;
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{Clock, EndpointState};

use super::receiver::Receiver;
use super::sender::{Daemon, event, life, on_disk, start, until, webhook};

#[tokio::test]
async fn a_receiver_that_was_down_for_a_day_gets_everything_in_order_on_return() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let config = webhook(dir.path(), &format!("http://{address}/hook?token=hunter2"));
    // An hour in a tenth of a second.
    let clock = Clock::fast(start(), 36_000.0);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], clock);
    for k in 0..20 {
        daemon.record(&life(&format!("a{k}")));
    }
    until(|| daemon.status().state == EndpointState::Failing).await;
    let status = daemon.status();
    let error = status.last_error.unwrap();
    assert!(error.to_lowercase().contains("refused"), "{error}");
    assert!(
        !error.contains("hunter2") && !status.url.contains("hunter2"),
        "{error} {}",
        status.url
    );

    until(|| clock.now() > start() + SignedDuration::from_hours(25)).await;
    assert_eq!(daemon.status().queued, 60);
    assert_eq!(daemon.status().failed, 0);
    let receiver = Receiver::on(tokio::net::TcpListener::bind(address).await.unwrap(), |_, _| {
        StatusCode::OK.into_response()
    });
    until(|| daemon.status().queued == 0).await;
    let got = receiver.accepted();
    assert_eq!(got.len(), 60);
    for k in 0..20 {
        let id = format!("a{k}");
        let types: Vec<&str> = got.iter().filter(|(a, _)| *a == id).map(|(_, t)| t.as_str()).collect();
        assert_eq!(types, ["alert.raised", "alert.updated", "alert.cleared"]);
    }
    daemon.stop().await;
}

#[tokio::test]
async fn retries_carry_the_same_id_and_a_new_signature() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        1 => StatusCode::NOT_FOUND.into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 1).await;
    let all = receiver.all();
    assert_eq!(all.len(), 3);
    assert!(
        all.iter()
            .all(|s| s.headers["webhook-id"] == all[0].headers["webhook-id"])
    );
    assert!(all.iter().all(|s| s.body == all[0].body));
    assert_ne!(all[0].headers["webhook-signature"], all[2].headers["webhook-signature"]);
    let sent = |k: usize| all[k].headers["webhook-timestamp"].parse::<i64>().unwrap();
    assert!(sent(1) - sent(0) >= 4, "5 s, in whole seconds");
    assert!(daemon.status().last_error.unwrap().contains("404"));
    daemon.stop().await;
}

#[tokio::test]
async fn redirects_are_not_followed() {
    let dir = tempfile::tempdir().unwrap();
    let trap = Receiver::accepting().await;
    let to = trap.url.clone();
    let receiver = Receiver::start(move |k, _| match k {
        0 => (StatusCode::TEMPORARY_REDIRECT, [("location", to.clone())]).into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 1).await;
    assert_eq!(receiver.all().len(), 2);
    assert!(trap.all().is_empty());
    assert!(daemon.status().last_error.unwrap().contains("redirect"));
    daemon.stop().await;
}

#[tokio::test]
async fn retry_after_is_honoured() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "240")]).into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().state == EndpointState::Failing).await;
    // Another alert's first attempt waits as well.
    daemon.record(&[event(AlertEventKind::Raised, "b", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 2).await;
    let all = receiver.all();
    let sent = |k: usize| all[k].headers["webhook-timestamp"].parse::<i64>().unwrap();
    assert!(sent(1) - sent(0) >= 239, "{} s", sent(1) - sent(0));
    assert_eq!(all.len(), 3);
    daemon.stop().await;
}

#[tokio::test]
async fn a_receiver_that_is_gone_is_left_alone_until_enabled_also_over_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => StatusCode::GONE.into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let configs = [webhook(dir.path(), &receiver.url)];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    daemon.record(&life("a"));
    until(|| daemon.status().state == EndpointState::Disabled).await;
    daemon.record(&life("b"));
    until(|| daemon.status().queued == 6).await;
    daemon.stop().await;

    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| daemon.status().queued == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Disabled);
    assert_eq!(receiver.all().len(), 1);
    daemon.notifier.enable(&daemon.status().name).await.unwrap();
    until(|| daemon.status().sent == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Working);
    assert!(daemon.notifier.enable("nobody").await.is_err());
    daemon.stop().await;

    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| daemon.status().sent == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Working);
    daemon.stop().await;
}

#[tokio::test]
async fn what_is_given_up_is_kept_and_can_be_replayed() {
    let dir = tempfile::tempdir().unwrap();
    let open = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let gate = open.clone();
    let receiver = Receiver::start(move |_, _| match gate.load(std::sync::atomic::Ordering::SeqCst) {
        true => StatusCode::OK.into_response(),
        false => StatusCode::BAD_REQUEST.into_response(),
    })
    .await;
    // The 75 hours of the schedule in under two seconds.
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 300_000.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().failed == 1).await;
    assert_eq!(daemon.status().queued, 0);
    let name = daemon.status().name;
    daemon.journal.settled().await;
    let dead = daemon.notifier.dead_letters(&name, 10).unwrap();
    assert_eq!((dead.len(), dead[0].alert.as_str()), (1, "a"));
    assert!(dead[0].error.contains("400"));
    assert!(dead[0].given_up_at > start() + SignedDuration::from_hours(75));

    open.store(true, std::sync::atomic::Ordering::SeqCst);
    assert_eq!(daemon.notifier.replay(&name, Some(999)).await.unwrap(), 0);
    assert_eq!(daemon.notifier.replay(&name, None).await.unwrap(), 1);
    until(|| daemon.status().sent == 1).await;
    assert_eq!((daemon.status().failed, daemon.status().queued), (0, 0));
    daemon.journal.settled().await;
    assert!(daemon.notifier.dead_letters(&name, 10).unwrap().is_empty());
    daemon.stop().await;
}

#[tokio::test]
async fn a_slow_receiver_holds_up_neither_others_nor_the_daemon() {
    let dir = tempfile::tempdir().unwrap();
    // Takes connections and never answers.
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut slow = webhook(dir.path(), &format!("http://{}/", silent.local_addr().unwrap()));
    slow.timeout_s = 1.0;
    let quick = Receiver::accepting().await;
    let configs = [slow, webhook(dir.path(), &quick.url)];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    for k in 0..30 {
        daemon.record(&life(&format!("a{k}")));
    }
    until(|| quick.accepted().len() == 90).await;
    until(|| daemon.status().last_error.as_deref() == Some("no answer in time")).await;
    assert_eq!(daemon.status().queued, 90);
    let stopping = Instant::now();
    daemon.stop().await;
    assert!(stopping.elapsed() < Duration::from_secs(4));
}

#[tokio::test]
async fn an_answer_without_end_is_not_read() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_, _| {
        let drops = futures_util::stream::repeat_with(|| Ok::<_, std::io::Error>(Bytes::from_static(&[b'x'; 1024])));
        Response::new(Body::from_stream(drops))
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let started = Instant::now();
    daemon.record(&life("a"));
    until(|| daemon.status().sent == 3).await;
    assert!(started.elapsed() < Duration::from_secs(10));
    daemon.stop().await;
}

/// What is no HTTP, breaks off, or contradicts itself is no receipt; a 2xx is one, whatever its body does.
#[tokio::test]
async fn a_receiver_that_lies_is_asked_until_it_answers_properly() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    const LIES: [&[u8]; 8] = [
        b"",
        b"\x00\xff\xfe garbage\r\n\r\n",
        b"HTTP/9.9 200 OK\r\n\r\n",
        b"HTTP/1.1 999999 OK\r\n\r\n",
        b"HTTP/1.1 200",
        b"HTTP/1.1 100 Continue\r\n\r\n",
        b"HTTP/1.1 200 OK\r\ncontent-length: 3\r\ncontent-length: 99\r\n\r\n",
        b"HTTP/1.1 500 OK\r\ncontent-length: 2\r\n\r\nOK",
    ];
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/", listener.local_addr().unwrap());
    let asked = Arc::new(std::sync::Mutex::new(Vec::new()));
    let receiver = tokio::spawn({
        let asked = asked.clone();
        async move {
            loop {
                let (mut stream, _) = listener.accept().await.unwrap();
                let mut request = vec![0; 16 << 10];
                let n = stream.read(&mut request).await.unwrap_or(0);
                let number = {
                    let mut asked = asked.lock().unwrap();
                    asked.push(String::from_utf8_lossy(&request[..n]).into_owned());
                    asked.len()
                };
                // A body that is shorter than announced comes with the receipt.
                let receipt = b"HTTP/1.1 200 OK\r\ncontent-length: 1000\r\n\r\nshort".as_slice();
                let _ = stream.write_all(LIES.get(number - 1).copied().unwrap_or(receipt)).await;
            }
        }
    });
    let clock = Clock::fast(start(), 36_000.0);
    let daemon = Daemon::start(&on_disk(dir.path()), &[webhook(dir.path(), &url)], clock);
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter)]);
    until(|| daemon.status().sent == 1).await;
    assert_eq!((daemon.status().failed, daemon.status().queued), (0, 0));
    let asked = asked.lock().unwrap().clone();
    let id = |request: &String| {
        let line = request
            .lines()
            .find(|l| l.to_ascii_lowercase().starts_with("webhook-id:"));
        line.map(str::to_owned)
    };
    assert_eq!(
        asked.len(),
        LIES.len() + 1,
        "one request a lie, and the one that was confirmed"
    );
    assert!(id(&asked[0]).is_some() && asked.iter().all(|r| id(r) == id(&asked[0])));
    receiver.abort();
    daemon.stop().await;
}
