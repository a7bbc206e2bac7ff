//! A config that is loaded again while the daemon runs.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::over_http::SCENE;
use super::process::{Daemon, alerts, receiver};

/// u-1 claims a place eight metres from where they are.
fn scene() -> String {
    SCENE.replace(
        "motion.still = [40, 40]",
        "motion.still = [40, 40]\nclaimed.still = [32, 40]",
    )
}

fn webhook(name: &str, port: u16) -> String {
    format!("[[webhook]]\nname = \"{name}\"\nurl = \"http://127.0.0.1:{port}/\"\nsecret_file = \"secret\"\n")
}

fn config(log: &str, tolerated_m: f64, webhooks: &[String]) -> String {
    format!(
        "[source]\nkind = \"simulator\"\nscene = \"scene.toml\"\n[journal]\npath = \"journal.db\"\n\
         [claims]\nlog = \"{log}\"\n[monitor]\ntolerated_distance_m = {tolerated_m}\n{}",
        webhooks.concat()
    )
}

#[test]
fn a_reload_changes_claims_monitor_and_webhooks_and_keeps_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("oapwatch.toml");
    std::fs::write(dir.path().join("scene.toml"), scene()).unwrap();
    let secret = "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=\n";
    std::fs::write(dir.path().join("secret"), secret).unwrap();
    let (port, bodies) = receiver("204 No Content");
    let of_stranger = |v: &serde_json::Value| {
        let kinds: Vec<_> = alerts(v)
            .iter()
            .map(|a| a["kind"].as_str().unwrap().to_owned())
            .collect();
        kinds.contains(&"unclaimed_emitter".to_owned())
    };
    let both = [webhook("stays", port), webhook("goes", port)];
    let daemon = Daemon::start(dir.path(), &config("a.ndjson", 20.0, &both));
    let before = daemon.wait_for("/v1/alerts", "the stranger's alert", of_stranger);
    daemon.wait_for("/v1/webhooks", "both told", |v| {
        let told = |k: usize| v["webhooks"][k]["sent"].as_u64() >= Some(1);
        told(0) && told(1)
    });
    assert_eq!(alerts(&before).len(), 1, "8 m are within 20: {before}");
    let seen = daemon.wait_for("/v1/positions", "positions", |v| v["frame"].as_u64() > Some(30));

    // A bad file changes nothing, although its first tables are good; nor does one whose zone has the name of one that was drawn.
    let corners = "[[200, 200], [210, 200], [210, 210], [200, 200]]";
    let drawn = format!(
        r#"{{"type": "FeatureCollection", "features": [{{"type": "Feature", "properties": {{"name": "yard", "kind": "watch"}},
            "geometry": {{"type": "Polygon", "coordinates": [{corners}]}}}}]}}"#
    );
    let (status, answer) = daemon.send("PUT", "/v1/zones", "", &drawn);
    assert_eq!(status, 200, "{answer}");
    let comes = config("b.ndjson", 5.0, &[webhook("comes", port)]);
    let bad = comes.replace("\"secret\"", "\"no-such-file\"");
    let same = format!("{comes}[[zone]]\nname = \"yard\"\nkind = \"watch\"\npolygon = [[0, 0], [9, 0], [9, 9]]\n");
    std::fs::write(dir.path().join("b.ndjson"), "no claim\n").unwrap();
    let mut frame = seen["frame"].as_u64();
    for bad in [bad, same] {
        std::fs::write(&file, bad).unwrap();
        daemon.signal("-HUP");
        frame = frame.map(|f| f + 20);
        daemon.wait_for("/v1/positions", "later positions", |v| v["frame"].as_u64() > frame);
        let status = daemon.wait_for("/v1/status", "status", |v| v["claims"]["log"].is_string());
        let log = status["claims"]["log"].as_str().unwrap();
        assert!(log.ends_with("a.ndjson"), "{status}");
        assert_eq!(status["webhooks"][1]["name"], "goes");
    }

    let good = config("b.ndjson", 5.0, &[webhook("comes", port), webhook("stays", port)]);
    std::fs::write(&file, good.replace("[journal]", "rate_hz = 20.0\n[journal]")).unwrap();
    daemon.signal("-HUP");
    let status = daemon.wait_for("/v1/status", "the other log", |v| {
        v["claims"]["log"].as_str().is_some_and(|log| log.ends_with("b.ndjson")) && v["claims"]["malformed"] == 1
    });
    let named: Vec<_> = (0..2).map(|k| status["webhooks"][k]["name"].clone()).collect();
    assert_eq!(named, ["comes", "stays"]);
    assert!(
        status["webhooks"][1]["sent"].as_u64() >= Some(1),
        "its queue and counts stay: {status}"
    );
    let after = daemon.wait_for("/v1/alerts", "a mismatch at 5 m", |v| {
        alerts(v)
            .iter()
            .any(|a| a["kind"] == "position_mismatch" && a["user"] == "u-1")
    });
    let stranger = |v: &serde_json::Value| alerts(v).iter().find(|a| a["kind"] == "unclaimed_emitter").cloned();
    let (was, is) = (stranger(&before).unwrap(), stranger(&after).unwrap());
    assert_eq!(
        (&is["id"], &is["state"]),
        (&was["id"], &"open".into()),
        "the alert goes on"
    );
    let track_of = |v: &serde_json::Value| {
        let beams = v["emitters"].as_array().cloned().unwrap_or_default();
        let beam = beams.iter().find(|e| e["user"].is_null());
        beam.map(|e| e["track"].clone())
    };
    let now = daemon.wait_for("/v1/positions", "positions", |v| track_of(v).is_some());
    assert_eq!(track_of(&now), track_of(&seen), "the track goes on");
    daemon.wait_for("/v1/webhooks", "the new webhook told", |v| {
        v["webhooks"][0]["sent"].as_u64() >= Some(1)
    });

    let counted = bodies.lock().unwrap().len();
    let (status, answer) = daemon.post("/v1/webhooks/comes/test", "");
    assert_eq!(status, 200, "{answer}");
    let answer: serde_json::Value = serde_json::from_str(&answer).unwrap();
    assert_eq!(
        (&answer["delivered"], &answer["status"]),
        (&true.into(), &204.into()),
        "{answer}"
    );
    let bodies = bodies.lock().unwrap();
    assert!(
        bodies[counted..]
            .iter()
            .any(|b| b.contains("\"type\":\"webhook.test\"")),
        "{bodies:?}"
    );
    assert_eq!(daemon.post("/v1/webhooks/comes/test", "").0, 429, "once in a while");
    assert_eq!(daemon.post("/v1/webhooks/goes/test", "").0, 404, "configured ones only");
    // Audit records are on disk a moment after the answer.
    daemon.wait_for("/v1/audit", "the test in the audit log", |v| {
        v.to_string().contains("webhook.test")
    });

    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0));
    let told = |words: &[&str]| log.iter().any(|line| words.iter().all(|word| line.contains(word)));
    assert!(told(&["nothing was changed", "no-such-file"]), "{log:?}");
    assert!(
        told(&["next restart only", "source"]),
        "what cannot be reloaded is named: {log:?}"
    );
}

/// Nothing but what changed is asked of a receiver that is slow: the request under way is not lost with the reload.
#[test]
fn a_delivery_under_way_survives_a_reload() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("scene.toml"), scene()).unwrap();
    let secret = "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=\n";
    std::fs::write(dir.path().join("secret"), secret).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let requests = Arc::new(AtomicUsize::new(0));
    let count = requests.clone();
    let (answer, may_answer) = std::sync::mpsc::channel::<()>();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { return };
            count.fetch_add(1, Ordering::SeqCst);
            let _ = may_answer.recv();
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n");
        }
    });
    let daemon = Daemon::start(dir.path(), &config("a.ndjson", 20.0, &[webhook("slow", port)]));
    daemon.wait_for("/v1/webhooks", "a request under way", |_| {
        requests.load(Ordering::SeqCst) == 1
    });
    let file = dir.path().join("oapwatch.toml");
    std::fs::write(&file, config("b.ndjson", 20.0, &[webhook("slow", port)])).unwrap();
    daemon.signal("-HUP");
    daemon.wait_for("/v1/status", "the reload", |v| {
        v["claims"]["log"].as_str().is_some_and(|log| log.ends_with("b.ndjson"))
    });
    drop(answer);
    daemon.wait_for("/v1/webhooks", "the delivery", |v| {
        v["webhooks"][0]["queued"] == 0 && v["webhooks"][0]["sent"] == 1
    });
    assert_eq!(requests.load(Ordering::SeqCst), 1, "sent once");
}
