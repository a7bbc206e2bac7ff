//! An alert event's way from a station to the readers of the hub's API.

use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use serde_json::Value;
use tokio_tungstenite::connect_async;
use tokio_tungstenite::tungstenite::Message;

use super::super::nats::{Server, hub, station_of};
use super::super::process::{Daemon, alerts};
use super::{QUIET, load, number, quantile, scene, standing_alert};

/// When each acknowledgement, or its withdrawal, is heard on a daemon's stream.
fn listen(daemon: &Daemon) -> Receiver<Instant> {
    let (sender, heard) = channel();
    let url = format!("ws://{}/v1/stream", daemon.address());
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let (mut socket, _) = connect_async(url).await.unwrap();
            while let Some(Ok(message)) = socket.next().await {
                let now = Instant::now();
                let Message::Text(text) = message else { continue };
                let is_ours = text.contains("\"alert.acknowledged\"") || text.contains("\"alert.unacknowledged\"");
                if is_ours && sender.send(now).is_err() {
                    return;
                }
            }
        });
    });
    heard
}

#[test]
#[ignore = "minutes; make fleet-measured"]
fn an_alert_s_way_to_the_hub() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let events = number("EVENTS", 600);
    let hub = hub(dir.path(), server.port);
    let station = station_of(dir.path(), "ap7", &scene(dir.path()), server.port, QUIET);
    let id = standing_alert(&station);
    hub.wait_for("/v1/alerts", "the alert", |v| !alerts(v).is_empty());
    let (at_station, at_hub) = (listen(&station), listen(&hub));
    std::thread::sleep(Duration::from_secs(1));
    let path = format!("/v1/alerts/{id}/acknowledge");
    let (mut from_request, mut from_station) = (Vec::new(), Vec::new());
    for k in 0..events {
        let method = if k % 2 == 0 { "POST" } else { "DELETE" };
        let asked = Instant::now();
        let (code, body) = station.send(method, &path, "", "");
        assert_eq!(code, 200, "{body}");
        let wait = Duration::from_secs(20);
        let said = at_station.recv_timeout(wait).expect("an event at the station");
        let heard = at_hub.recv_timeout(wait).expect("an event at the hub");
        from_request.push(1e3 * (heard - asked).as_secs_f64());
        from_station.push(1e3 * heard.saturating_duration_since(said).as_secs_f64());
        // Whatever the phase of the hub's ticks and the station's frames.
        std::thread::sleep(Duration::from_millis(37 + k % 61));
    }
    let shown: Value = serde_json::from_str(&hub.get(&format!("/v1/alerts/harbour.ap7.{id}")).1).unwrap();
    assert_eq!(shown["state"], "open", "{shown}");
    println!(
        "| {events} events, load {} | median, ms | p99, ms | longest, ms |\n|---|---|---|---|",
        load()
    );
    for (what, times) in [
        ("from the station's stream to the hub's", &mut from_station),
        (
            "from the request at the station, which waits for its disk",
            &mut from_request,
        ),
    ] {
        let at: Vec<String> = [0.5, 0.99, 1.0].map(|q| format!("{:.1}", quantile(times, q))).into();
        println!("| {what} | {} |", at.join(" | "));
    }
}
