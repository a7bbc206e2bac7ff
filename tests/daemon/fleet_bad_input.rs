//! Messages that a hub must not believe: refused, counted, and shown with their station.

use std::path::Path;
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};

use crate::journals::events;
use crate::nats::{Server, hub};

fn health(station: &str, version: u32) -> Value {
    json!({ "version": version, "site": "harbour", "station": station, "time": Timestamp::now(), "status": null, "alerts_waiting": 0 })
}

/// A user `u` at `x_m`, in a frame of `age_s` seconds ago.
fn positions(station: &str, age_s: f64, x_m: f64) -> Value {
    let time = Timestamp::now() - SignedDuration::from_secs_f64(age_s);
    json!({
        "version": 1, "site": "harbour", "station": station, "time": time, "frame": 1, "unseen": [], "claims": [],
        "field_of_view_m": [125.0, 125.0],
        "emitters": [{ "track": 1, "x_m": x_m, "y_m": 0.0, "cov_m2": [[0.01, 0.0], [0.0, 0.01]], "energy_j": 0.01, "user": "u",
                       "status": "verified", "flags": [] }],
    })
}

fn alert(station: &str, seq: u64) -> Value {
    json!({
        "version": 1, "site": "harbour", "station": station, "journal": "j", "seq": seq, "at": Timestamp::now(),
        "event": "alert.raised",
        "alert": {
            "id": format!("a-{seq}"), "kind": "unclaimed_emitter", "severity": "critical", "state": "open",
            "raised_at": Timestamp::now(), "cleared_at": null, "user": null, "x_m": 100.0 * seq as f64, "y_m": 0.0, "cov_m2": null,
            "claimed": null, "evidence": "no object", "source": { "kind": "simulator", "frame": 0 },
        },
    })
}

async fn publish(port: u16, messages: &[(&str, String)]) {
    let client = async_nats::connect(format!("127.0.0.1:{port}")).await.unwrap();
    for (subject, body) in messages {
        client
            .publish(format!("oapwatch.harbour.{subject}"), body.clone().into())
            .await
            .unwrap();
        client.flush().await.unwrap();
    }
}

fn count(metrics: &str, topic: &str, outcome: &str) -> u64 {
    let is_it = |l: &&str| l.starts_with("oapwatch_fleet_messages_total") && l.contains(topic) && l.contains(outcome);
    let line = metrics.lines().find(is_it);
    line.map_or(0, |l| l.rsplit(' ').next().unwrap().parse().unwrap())
}

#[test]
fn what_cannot_be_believed_is_refused_counted_and_shown() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let hub = hub(dir.path(), server.port);
    hub.wait_for("/v1/alerts", "an answer", |v| v["alerts"].is_array());
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let of = |stations: &Value, name: &str| {
        stations["stations"]
            .as_array()?
            .iter()
            .find(|s| s["station"] == name)
            .cloned()
    };
    // Again until the hub listens; it has read it before a newer one takes its place.
    let is_known = || of(&serde_json::from_str(&hub.get("/v1/stations").1).unwrap(), "ap1").is_some();
    let end = Instant::now() + Duration::from_secs(20);
    while !is_known() {
        assert!(Instant::now() < end, "ap1 is not known within 20 s");
        let first = [("ap1.positions", positions("ap1", 0.0, 0.0).to_string())];
        runtime.block_on(publish(server.port, &first));
        std::thread::sleep(Duration::from_millis(200));
    }
    let messages = [
        ("ap1.positions", positions("ap1", 1.5, 40.0).to_string()),
        ("ap2.health", health("ap2", 2).to_string()),
        ("ap3.health", "{".to_owned()),
        ("ap4.health", health("ap5", 1).to_string()),
        ("ap6.positions", positions("ap6", 3.0 * 3600.0, 500.0).to_string()),
        ("ap1.alert", alert("ap1", 1).to_string()),
        ("ap1.alert", alert("ap1", 2).to_string()),
        ("ap1.alert", alert("ap1", 1).to_string()),
        (
            "ap7.alert",
            json!({ "version": 1, "site": "harbour", "station": "ap7", "alert": 3 }).to_string(),
        ),
        // An unknown word in place of the topic is nobody's.
        ("ap8.weather", health("ap8", 1).to_string()),
    ];
    runtime.block_on(publish(server.port, &messages));
    let all = hub.wait_for("/v1/stations", "all that was said", |v| {
        let is_late = of(v, "ap1").is_some_and(|s| s["refused"] != json!({}));
        is_late
            && ["ap2", "ap3", "ap4", "ap6", "ap7"]
                .iter()
                .all(|name| of(v, name).is_some())
    });
    for (station, reason) in [
        ("ap1", "late"),
        ("ap2", "other_version"),
        ("ap3", "malformed"),
        ("ap4", "other_station"),
        ("ap7", "malformed"),
    ] {
        let shown = of(&all, station).unwrap_or_else(|| panic!("no {station} in {all}"));
        assert_eq!(shown["refused"], json!({ reason: 1 }), "{shown}");
        assert_eq!(shown["state"] == "refused", station != "ap1", "{shown}");
    }
    assert!(of(&all, "ap5").is_none() && of(&all, "ap8").is_none(), "{all}");
    // Hours off: shown, with how far, and not compared.
    let off = of(&all, "ap6").unwrap();
    assert_eq!(
        [&off["is_compared"], &of(&all, "ap1").unwrap()["is_compared"]],
        [false, true]
    );
    assert!((off["lag_s"].as_f64().unwrap() - 3.0 * 3600.0).abs() < 10.0, "{off}");
    let listed = hub.get("/v1/alerts?kind=user_in_two_places").1;
    assert!(!listed.contains("\"id\""), "{listed}");

    let metrics = hub.get("/metrics").1;
    for (topic, outcome) in [
        ("positions", "late"),
        ("health", "other_version"),
        ("health", "malformed"),
        ("health", "other_station"),
        ("alert", "malformed"),
        ("alert", "repeated"),
    ] {
        assert_eq!(count(&metrics, topic, outcome), 1, "{topic} {outcome} in {metrics}");
    }
    let journal: &Path = &dir.path().join("hub/journal.db");
    let ids: Vec<String> = events(journal, "harbour.ap1.").into_iter().map(|(id, ..)| id).collect();
    assert_eq!(ids, ["a-1", "a-2"]);
}
