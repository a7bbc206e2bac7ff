//! What operators and the network do to a running daemon over HTTP.

use super::process::{Daemon, alerts, receiver};

/// One user who stands still and somebody nobody knows.
pub const SCENE: &str = r#"
rate_hz = 10.0

[optics]
altitude_m = 300.0
lens_radius_m = 0.05
plane_distance_m = 0.036
pixels = [32, 32]
sensor_size_m = [0.03, 0.03]
spot_sigma_m = 0.001
noise_std_j = 1.0e-6

[link]
integration_time_s = 0.1
coherence_time_s = 0.01

[effects]
thermal_noise = {}

[[user]]
name = "u-1"
motion.still = [40, 40]

[[intruder]]
name = "stranger"
motion.still = [-30, 10]
"#;

const CONFIG: &str = r#"
[source]
kind = "simulator"
scene = "scene.toml"

[journal]
path = "journal.db"
"#;

fn value_of(metrics: &str, series: &str) -> f64 {
    let line = metrics
        .lines()
        .find(|l| l.strip_prefix(series).is_some_and(|rest| rest.starts_with(' ')));
    line.and_then(|l| l.rsplit(' ').next()?.parse().ok())
        .unwrap_or(f64::NAN)
}

#[test]
fn claims_are_counted_by_what_became_of_them() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("scene.toml"), SCENE).unwrap();
    let daemon = Daemon::start(dir.path(), CONFIG);
    daemon.wait_for("/v1/positions", "positions", |v| v["frame"].as_u64() > Some(3));
    let before = daemon.get("/metrics").1;
    let claim = |t: &str, x: f64| format!(r#"{{"time":"{t}","user":"tester","x_m":{x},"y_m":0}}"#);
    let (t0, t1, t2) = ("2020-01-01T00:00:00Z", "2020-01-01T00:00:01Z", "2020-01-01T00:00:02Z");
    let body = [
        claim(t0, 1.0),
        claim(t2, 1.0),
        claim(t2, 1.0),
        claim(t2, 9.0),
        claim(t1, 1.0),
        "{oops".into(),
    ];
    let (status, answer) = daemon.post("/v1/claims", &body.join("\n"));
    assert_eq!(status, 200, "{answer}");
    // What contradicts and what is no claim is refused, with the line.
    let answer: serde_json::Value = serde_json::from_str(&answer).unwrap();
    assert_eq!(
        (&answer["accepted"], &answer["refused"]),
        (&4.into(), &2.into()),
        "{answer}"
    );
    assert_eq!(
        (&answer["reasons"][0]["line"], &answer["reasons"][1]["line"]),
        (&4.into(), &6.into()),
        "{answer}"
    );
    daemon.wait_for("/v1/status", "the count", |v| {
        v["claims"]["malformed"].as_u64() >= Some(0)
    });
    let frame = daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64())["frame"].as_u64();
    daemon.wait_for("/v1/positions", "a later frame", |v| {
        v["frame"].as_u64() > frame.map(|f| f + 2)
    });
    let after = daemon.get("/metrics").1;
    for (outcome, least) in [
        ("accepted", 2.0),
        ("duplicate", 1.0),
        ("refused", 1.0),
        ("late", 1.0),
        ("malformed", 1.0),
    ] {
        let series = format!("oapwatch_claims_total{{outcome=\"{outcome}\"}}");
        let was = value_of(&before, &series);
        let grown = value_of(&after, &series) - if was.is_nan() { 0.0 } else { was };
        // The simulator's own users claim beside the tester.
        let exact = outcome != "accepted";
        assert!(
            if exact { grown == least } else { grown >= least },
            "{outcome}: {grown}\n{after}"
        );
    }
    let last = value_of(&after, "oapwatch_claims_last_timestamp_seconds");
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .unwrap()
        .as_secs_f64();
    assert!((now - last).abs() < 60.0, "{last} against {now}");
    // The same for the status: the simulator's users claim, and nobody else's claim is newer.
    let (_, status) = daemon.get("/v1/status");
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    let told: jiff::Timestamp = status["claims"]["last_at"].as_str().unwrap().parse().unwrap();
    assert!((told.as_millisecond() as f64 * 1e-3 - last).abs() < 60.0, "{status}");
}

#[test]
fn an_acknowledged_alert_is_the_same_one_after_kill_9() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("scene.toml"), SCENE).unwrap();
    let first = Daemon::start(dir.path(), CONFIG);
    let list = first.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert", |v| !alerts(v).is_empty());
    let id = alerts(&list)[0]["id"].as_str().unwrap().to_owned();
    let path = format!("/v1/alerts/{id}/acknowledge");
    let (status, answer) = first.post(&path, "");
    assert_eq!(status, 200, "{answer}");
    assert!(answer.contains("\"acknowledged\""), "{answer}");
    // Once more is no change and no error; another alert is none at all.
    assert_eq!(first.post(&path, "").0, 200);
    assert_eq!(first.post("/v1/alerts/no-such/acknowledge", "").0, 404);
    first.signal("-KILL");
    first.end();

    let second = Daemon::start(dir.path(), CONFIG);
    // Long enough for a run of its own to decide: the stranger is still there, and still the same alert.
    second.wait_for("/v1/positions", "frames", |v| v["frame"].as_u64() > Some(60));
    let (_, list) = second.get("/v1/alerts?kind=unclaimed_emitter");
    let list: serde_json::Value = serde_json::from_str(&list).unwrap();
    assert_eq!(alerts(&list).len(), 1, "{list}");
    assert_eq!(alerts(&list)[0]["id"], id.as_str());
    assert_eq!(alerts(&list)[0]["state"], "acknowledged");
    let positions = second.wait_for("/v1/positions", "positions", |v| v["emitters"].is_array());
    let unclaimed = positions["emitters"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|e| e["status"] == "unclaimed");
    assert_eq!(unclaimed.count(), 1, "{positions}");
}

#[test]
fn a_webhook_that_is_gone_is_seen_and_enabled_over_the_api() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("scene.toml"), SCENE).unwrap();
    std::fs::write(
        dir.path().join("secret"),
        "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=\n",
    )
    .unwrap();
    let (port, requests) = receiver("410 Gone");
    let webhook =
        format!("[[webhook]]\nname = \"soc\"\nurl = \"http://127.0.0.1:{port}/\"\nsecret_file = \"secret\"\n");
    let daemon = Daemon::start(dir.path(), &format!("{CONFIG}{webhook}"));
    let endpoint = |v: &serde_json::Value| v["webhooks"][0].clone();
    let gone = daemon.wait_for("/v1/webhooks", "410", |v| endpoint(v)["state"] == "disabled");
    assert!(endpoint(&gone)["queued"].as_u64() >= Some(1), "{gone}");
    assert_eq!(requests.lock().unwrap().len(), 1);
    assert!(!gone.to_string().contains("whsec"), "{gone}");

    assert_eq!(daemon.post("/v1/webhooks/no-such/enable", "").0, 404);
    assert_eq!(daemon.post("/v1/webhooks/soc/enable", "").0, 204);
    daemon.wait_for("/v1/webhooks", "delivery", |v| {
        endpoint(v)["state"] == "working" && endpoint(v)["queued"] == 0 && endpoint(v)["sent"].as_u64() >= Some(1)
    });
    assert!(requests.lock().unwrap().len() >= 2);

    let (status, letters) = daemon.get("/v1/webhooks/soc/dead-letters");
    assert_eq!((status, letters.as_str()), (200, r#"{"dead_letters":[]}"#));
    assert_eq!(daemon.get("/v1/webhooks/no-such/dead-letters").0, 404);
    assert_eq!(
        daemon.post("/v1/webhooks/soc/replay", ""),
        (200, r#"{"queued":0}"#.into())
    );
    assert_eq!(daemon.post("/v1/webhooks/soc/replay?seq=x", "").0, 400);
    assert_eq!(
        daemon.post("/v1/webhooks/soc/replay?seq=9223372036854775808", "").0,
        400
    );
}
