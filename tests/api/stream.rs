//! The WebSocket through tungstenite's client, and server-sent events.

use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use oapwatch::api::Config;
use serde_json::Value;
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

use crate::fake::Fake;

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Long enough for a busy machine; nothing here waits this long when it works.
const PATIENCE: Duration = Duration::from_secs(20);

async fn connect(fake: &Fake, query: &str) -> Socket {
    let url = format!("ws://{}/v1/stream{query}", fake.address);
    connect_async(url).await.unwrap().0
}

async fn message(socket: &mut Socket) -> Value {
    loop {
        match timeout(PATIENCE, socket.next()).await.unwrap().unwrap().unwrap() {
            Message::Text(text) => return serde_json::from_str(&text).unwrap(),
            Message::Ping(_) | Message::Pong(_) => {}
            other => panic!("expected text, found {other:?}"),
        }
    }
}

fn seq(message: &Value) -> u64 {
    message["seq"].as_u64().unwrap()
}

#[tokio::test]
async fn a_snapshot_then_changes_in_order() {
    let fake = Fake::start(Config::default()).await;
    fake.alert("a-0", 0).await;
    fake.step(1);
    let mut socket = connect(&fake, "").await;
    let snapshot = message(&mut socket).await;
    assert_eq!(snapshot["type"], "snapshot");
    assert_eq!(snapshot["frame"], 1);
    assert_eq!(snapshot["alerts"][0]["id"], "a-0");
    assert_eq!(snapshot["emitters"].as_array().unwrap().len(), 3);
    assert_eq!(snapshot["claims"].as_array().unwrap().len(), 3);

    fake.alert("a-1", 1).await;
    fake.step(2);
    let alert = message(&mut socket).await;
    assert_eq!(
        (&alert["type"], &alert["event"]),
        (&"alert".into(), &"alert.raised".into())
    );
    assert_eq!(alert["alert"]["id"], "a-1");
    let positions = message(&mut socket).await;
    assert_eq!(
        (&positions["type"], &positions["frame"]),
        (&"positions".into(), &2.into())
    );
    assert_eq!(positions["missed"], 0);
    assert_eq!(seq(&alert), seq(&snapshot) + 1);
    assert_eq!(seq(&positions), seq(&snapshot) + 2);
    fake.stop().await;
}

#[tokio::test]
async fn a_slow_reader_loses_positions_but_no_alert_and_is_told_how_many() {
    let fake = Fake::start(Config::default()).await;
    fake.step(0);
    let mut socket = connect(&fake, "").await;
    assert_eq!(message(&mut socket).await["type"], "snapshot");
    // Nothing yields between these, so that the reader's task finds them all at once.
    let (steps, events) = (3000, 1500);
    for k in 1..=steps {
        fake.step(k);
        if k <= events {
            fake.raise_at_once(&format!("a-{k}"));
        }
    }
    fake.journal.settled().await;
    let (mut told, mut seen, mut alerts, mut last) = (0, 0, Vec::new(), 0);
    while seen + told < steps || (alerts.len() as u64) < events {
        let m = message(&mut socket).await;
        assert!(seq(&m) > last, "{} after {last}", seq(&m));
        last = seq(&m);
        if m["type"] == "alert" {
            alerts.push(m["alert"]["id"].as_str().unwrap().to_owned());
        } else {
            seen += 1;
            told += m["missed"].as_u64().unwrap();
            assert_eq!(m["frame"].as_u64().unwrap(), seen + told);
        }
    }
    assert_eq!(alerts, (1..=events).map(|k| format!("a-{k}")).collect::<Vec<_>>());
    assert!(told > 0);
    fake.stop().await;
}

#[tokio::test]
async fn a_reader_goes_on_where_it_was_even_after_a_restart() {
    let fake = Fake::start(Config::default()).await;
    fake.step(1);
    let mut socket = connect(&fake, "").await;
    let seen = seq(&message(&mut socket).await);
    drop(socket);
    fake.alert("while-away", 1).await;
    let journal = fake.journal.clone();
    fake.stop().await;

    let fake = Fake::resume(Config::default(), journal, 2).await;
    fake.alert("in-the-next-run", 2).await;
    let mut socket = connect(&fake, &format!("?after={seen}")).await;
    let snapshot = message(&mut socket).await;
    assert_eq!(
        (&snapshot["type"], &snapshot["resumed"]),
        (&"snapshot".into(), &true.into())
    );
    let mut last = seq(&snapshot);
    assert_eq!(last, seen);
    for id in ["while-away", "in-the-next-run"] {
        let alert = message(&mut socket).await;
        assert_eq!(alert["alert"]["id"], id);
        assert!(seq(&alert) > last);
        last = seq(&alert);
    }

    let mut socket = connect(&fake, "?after=9000000000000000").await;
    assert_eq!(message(&mut socket).await["resumed"], false, "a number nobody gave");
    fake.stop().await;
}

#[tokio::test]
async fn pings_are_answered_and_streams_are_told_when_the_daemon_stops() {
    let fake = Fake::start(Config::default()).await;
    let mut socket = connect(&fake, "").await;
    message(&mut socket).await;
    socket.send(Message::Ping("hello".into())).await.unwrap();
    let pong = timeout(PATIENCE, socket.next()).await.unwrap().unwrap().unwrap();
    assert_eq!(pong, Message::Pong("hello".into()));
    fake.stop().await;
    let close = timeout(PATIENCE, socket.next()).await.unwrap().unwrap().unwrap();
    let Message::Close(Some(frame)) = close else {
        panic!("expected a close, found {close:?}")
    };
    assert_eq!(u16::from(frame.code), 1001);
}

#[tokio::test]
async fn a_client_that_talks_too_much_is_cut_off() {
    let fake = Fake::start(Config::default()).await;
    let mut socket = connect(&fake, "").await;
    message(&mut socket).await;
    socket.send(Message::Text("x".repeat(100_000).into())).await.unwrap();
    let ended = timeout(PATIENCE, async {
        while let Some(Ok(message)) = socket.next().await {
            if message.is_close() {
                break;
            }
        }
    });
    ended.await.expect("the connection ends");
    fake.stop().await;
}

#[tokio::test]
async fn server_sent_events_carry_the_same_and_resume_by_last_event_id() {
    let fake = Fake::start(Config::default()).await;
    fake.step(1);
    let open = async |last: Option<&str>| {
        let mut request = reqwest::Client::new().get(fake.url("/v1/events"));
        if let Some(last) = last {
            request = request.header("Last-Event-ID", last);
        }
        let response = request.send().await.unwrap();
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        response
    };
    let read = async |response: &mut reqwest::Response, until: &str| {
        let mut text = String::new();
        while !text.contains(until) {
            let chunk = timeout(PATIENCE, response.chunk()).await.unwrap().unwrap().unwrap();
            text.push_str(std::str::from_utf8(&chunk).unwrap());
        }
        text
    };
    let mut events = open(None).await;
    let first = read(&mut events, "\n\n").await;
    assert!(first.contains("event: snapshot"), "{first}");
    let id = first.lines().find_map(|l| l.strip_prefix("id: ")).unwrap().to_owned();
    drop(events);
    fake.alert("a-1", 1).await;
    let mut events = open(Some(&id)).await;
    let resumed = read(&mut events, "alert.raised").await;
    assert!(resumed.contains("a-1"), "{resumed}");
    fake.stop().await;
}
