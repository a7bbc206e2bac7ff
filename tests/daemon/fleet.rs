//! Stations, a real NATS server and the hub, killed while alerts flow.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures_util::StreamExt;
use serde_json::{Value, json};

use crate::journals::agree;
use crate::nats::{Server, hub, station, station_with};
use crate::port::free_port;
use crate::process::{Daemon, alerts};

#[test]
fn alerts_reach_the_hub_once_each_whoever_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let port = server.port;
    let hub_daemon = hub(dir.path(), port);
    let ap7 = station(dir.path(), "ap7", "eavesdropper", port);
    let is_alert = |v: &Value| alerts(v).iter().any(|a| a["kind"] == "unclaimed_emitter");
    let seen = hub_daemon.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert of ap7", is_alert);
    assert_eq!(alerts(&seen)[0]["station"], "ap7");
    assert_eq!(alerts(&seen)[0]["site"], "harbour");
    let placed = |v: &Value| {
        v["emitters"]
            .as_array()
            .is_some_and(|e| e.iter().any(|e| e["station"] == "ap7"))
    };
    hub_daemon.wait_for("/v1/positions", "positions of ap7", placed);

    // The link is gone while a second station raises its first alerts.
    let port = server.kill();
    let ap8 = station(dir.path(), "ap8", "builtin", port);
    ap8.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert at ap8", is_alert);
    // Dropping kills as -9 does.
    drop((hub_daemon, ap7));
    let _ap7 = station(dir.path(), "ap7", "eavesdropper", port);
    let _server = Server::start(dir.path(), Some(port)).unwrap();
    let hub_daemon = hub(dir.path(), port);
    let of_ap8 = |v: &Value| {
        alerts(v)
            .iter()
            .any(|a| a["station"] == "ap8" && a["kind"] == "unclaimed_emitter")
    };
    hub_daemon.wait_for("/v1/alerts?limit=500", "alert of ap8", of_ap8);

    // What a station has, the hub has once, in order; alerts that two stations share are one of theirs.
    agree(dir.path(), "hub", "ap7", Duration::from_secs(20));
}

#[test]
fn claims_come_over_nats_in_the_format_of_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let port = server.port;
    let config = format!(
        "[claims]\nformat = \"csv\"\n[fleet]\nurl = \"nats://127.0.0.1:{port}\"\nsite = \"harbour\"\nstation = \"ap7\"\n\
         claims_subject = \"network.*.claims\"\n"
    );
    let daemon = Daemon::start(dir.path(), &config);
    daemon.wait_until_up();
    let stop = Arc::new(AtomicBool::new(false));
    let publishing = {
        let stop = stop.clone();
        move || async move {
            let client = async_nats::connect(format!("127.0.0.1:{port}")).await.unwrap();
            while !stop.load(Ordering::Relaxed) {
                let now = jiff::Timestamp::now();
                let lines = format!("time,user,x_m,y_m\n{now},by-nats,40,-60\n{now},nowhere,far,away\n");
                client.publish("network.harbour.claims", lines.into()).await.unwrap();
                client.flush().await.unwrap();
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    };
    let publisher = std::thread::spawn(|| {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(publishing());
    });
    // No beam comes from there.
    daemon.wait_for("/v1/alerts?kind=user_unseen", "unseen user", |v| {
        alerts(v).iter().any(|a| a["user"] == "by-nats")
    });
    stop.store(true, Ordering::Relaxed);
    publisher.join().unwrap();
    let metrics = daemon.get("/metrics").1;
    let malformed = metrics
        .lines()
        .find_map(|l| l.strip_prefix("oapwatch_claims_total{outcome=\"malformed\"} "));
    assert!(malformed.is_some_and(|n| n.parse::<u64>().unwrap() > 0), "{metrics}");
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0));
    let told: Vec<_> = log
        .iter()
        .filter(|l| l.contains("a claim cannot be taken: line 3: "))
        .collect();
    assert_eq!(told.len(), 1, "{log:?}");
}

#[test]
fn a_silent_station_is_missed_and_a_user_in_two_places_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let hub = hub(dir.path(), server.port);
    let ap7 = station(dir.path(), "ap7", "eavesdropper", server.port);
    let _ap8 = station(dir.path(), "ap8", "builtin", server.port);
    let both = |v: &Value| {
        v["stations"]
            .as_array()
            .is_some_and(|s| s.len() == 2 && s.iter().all(|s| s["state"] == "good"))
    };
    hub.wait_for("/v1/stations", "both stations", both);
    // Both scenes have a user u-1, at different places.
    let told = hub.wait_for("/v1/alerts?kind=user_in_two_places", "conflict", |v| {
        !alerts(v).is_empty()
    });
    let places = alerts(&told)[0]["evidence"]["places"].as_array().unwrap();
    assert_eq!(places.len(), 2);
    assert_ne!(places[0]["station"], places[1]["station"]);

    drop(ap7);
    let lost = hub.wait_for("/v1/alerts?kind=station_lost", "lost station", |v| {
        !alerts(v).is_empty()
    });
    assert_eq!(alerts(&lost)[0]["station"], "ap7");
    let _ap7 = station(dir.path(), "ap7", "eavesdropper", server.port);
    let cleared = |v: &Value| alerts(v).first().is_some_and(|a| a["state"] == "cleared");
    hub.wait_for("/v1/alerts?kind=station_lost", "station back", cleared);
}

/// A heartbeat of system 7 and one pose, again and again.
fn fly(port: u16, is_over: &AtomicBool) {
    let bytes = |hex: &str| {
        let digits: Vec<u8> = hex.trim().chars().map(|c| c.to_digit(16).unwrap() as u8).collect();
        digits.chunks(2).map(|pair| 16 * pair[0] + pair[1]).collect::<Vec<u8>>()
    };
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let frames = [
        include_str!("../platform/heartbeat.hex"),
        include_str!("../platform/odometry.hex"),
    ]
    .map(bytes);
    while !is_over.load(Ordering::Relaxed) {
        for frame in &frames {
            let _ = socket.send_to(frame, ("127.0.0.1", port));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// What is published on `subject` within two seconds.
fn heard(port: u16, subject: &'static str) -> Vec<Value> {
    let listening = async move {
        let client = async_nats::connect(format!("127.0.0.1:{port}")).await.unwrap();
        let mut messages = client.subscribe(subject).await.unwrap();
        client.flush().await.unwrap();
        let mut heard = Vec::new();
        let end = tokio::time::Instant::now() + Duration::from_secs(2);
        while let Ok(Some(message)) = tokio::time::timeout_at(end, messages.next()).await {
            heard.push(serde_json::from_slice(&message.payload).unwrap());
        }
        heard
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(listening)
}

#[test]
fn the_hub_shows_where_the_platforms_are() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let autopilot = free_port();
    let platform =
        format!("positions_hz = 4.0\n[platform]\nkind = \"mavlink\"\nendpoint = \"udpin:127.0.0.1:{autopilot}\"\n");
    let hub = hub(dir.path(), server.port);
    let _ap7 = station_with(dir.path(), "ap7", "builtin", server.port, &platform);
    let _ap8 = station(dir.path(), "ap8", "builtin", server.port);
    let is_over = AtomicBool::new(false);
    let of = |v: &Value, name: &str| v["stations"].as_array()?.iter().find(|s| s["station"] == name).cloned();
    let messages = std::thread::scope(|scope| {
        scope.spawn(|| fly(autopilot, &is_over));
        let seen = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let both = |v: &Value| {
                of(v, "ap7").is_some_and(|s| s["pose"]["place"].is_object())
                    && of(v, "ap8").is_some_and(|s| s["emitters"] != 0)
            };
            let seen = hub.wait_for("/v1/stations", "a pose of ap7 and beams of ap8", both);
            let ap7 = of(&seen, "ap7").unwrap();
            let place = &ap7["pose"]["place"];
            assert_eq!(
                [&place["x_m"], &place["y_m"], &place["z_m"], &place["heading_deg"]],
                [20.0, 10.0, 100.0, 0.0],
                "{ap7}"
            );
            assert_eq!(ap7["pose"]["is_lost"], false);
            // What the pose and the positions say is not said again.
            assert!(ap7["status"]["view"].is_null(), "{ap7}");
            assert!(
                of(&seen, "ap8").unwrap()["pose"].is_null(),
                "a fixed platform has no poses"
            );
            heard(server.port, "oapwatch.harbour.*.pose")
        }));
        is_over.store(true, Ordering::Relaxed);
        seen.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    assert!((2..=9).contains(&messages.len()), "4 a second at most: {messages:?}");
    for message in &messages {
        assert_eq!(
            [
                &message["version"],
                &message["site"],
                &message["station"],
                &message["source"]
            ],
            [&json!(1), &json!("harbour"), &json!("ap7"), &json!("mavlink")]
        );
        assert_eq!(message["pose"]["cov"].as_array().map(Vec::len), Some(6), "{message}");
    }
    hub.wait_for("/v1/stations", "that the pose is old", |v| {
        of(v, "ap7").is_some_and(|s| s["pose"]["is_lost"] == true && s["pose"]["place"]["age_s"].as_f64() > Some(1.0))
    });
}
