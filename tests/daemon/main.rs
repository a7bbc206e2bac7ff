//! The daemon as an operator meets it: a process, an address, signals.

mod fleet;
mod fleet_bad_input;
mod fleet_leaf;
mod fleet_measured;
mod fleet_permissions;
mod fleet_review;
mod geojson;
mod journals;
mod nats;
mod over_http;
mod places;
mod port;
mod process;
mod reload;
mod siege;
mod telemetry;

use std::io::Write;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use process::{Daemon, alerts};
use serde_json::Value;

#[test]
fn on_the_simulator_users_are_verified_and_the_eavesdropper_is_alerted() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = Daemon::start(dir.path(), "");
    let seen = daemon.wait_for("/v1/positions", "verified users", |v| {
        let emitters = v["emitters"].as_array().cloned().unwrap_or_default();
        emitters.iter().filter(|e| e["status"] == "verified").count() >= 5
    });
    let named = seen["emitters"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|e| e["user"].is_string());
    assert!(named.count() >= 5, "{seen}");
    let list = daemon.wait_for("/v1/alerts", "alert", |v| {
        alerts(v).iter().any(|a| a["kind"] == "unclaimed_emitter")
    });
    assert_eq!(
        alerts(&list).len(),
        1,
        "nobody but the eavesdropper is out of place: {list}"
    );
    let stopped = Instant::now();
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0), "{log:?}");
    assert!(
        stopped.elapsed() < Duration::from_secs(2),
        "took {:?} to stop",
        stopped.elapsed()
    );
}

#[test]
fn an_alert_survives_kill_9() {
    let dir = tempfile::tempdir().unwrap();
    let config = "[journal]\npath = \"journal.db\"\n";
    let first = Daemon::start(dir.path(), config);
    let before = first.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    first.signal("-KILL");
    let (code, _) = first.end();
    assert_eq!(code, None);
    let second = Daemon::start(dir.path(), config);
    let after = second.wait_for("/v1/alerts", "alert of the first run", |v| !alerts(v).is_empty());
    let ids = |v: &Value| {
        alerts(v)
            .iter()
            .map(|a| a["id"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    for id in ids(&before) {
        assert!(ids(&after).contains(&id), "{id} is lost");
    }
}

#[test]
fn a_bad_config_ends_the_program_before_a_port_is_bound() {
    let dir = tempfile::tempdir().unwrap();
    for (config, message) in [
        ("[optics]\nspot_sigma = 0.001\n", "did you mean `spot_sigma_m`?"),
        (
            "[optics]\naltitude_m = -3.0\n",
            "optics.altitude_m: expected a positive finite number, found -3",
        ),
        ("[estimator]\nname = \"grredy-fit\"\n", "did you mean"),
        (
            "[platform]\nkind = \"mavlink\"\nendpoint = \"serial:/dev/ttyS0:57600\"\n",
            "platform.endpoint: expected udpin:ADDR:PORT",
        ),
        (
            "[platform]\nkind = \"mavlink\"\nendpoint = \"tcp:[::1]:5760\"\nsigning_key_file = \"missing.key\"\n",
            "platform.signing_key_file:",
        ),
        (
            "[platform]\nkind = \"replay\"\nposes = \"missing.ulg\"\n",
            "missing.ulg",
        ),
        ("[api]\nlisten = \"0.0.0.0:0\"\n", "api.token_file is needed"),
        ("[source]\nkind = \"replay\"\n", "source.frames"),
        (
            "[monitor]\ntolerated_distance_m = nan\n",
            "monitor.tolerated_distance_m",
        ),
        (
            "[monitor]\ndecision_s = 1e9\n",
            "monitor.decision_s: expected 0.001 to 3600",
        ),
        ("[log]\nlevel = \"loud\"\n", "log.level: expected off, error"),
        ("[record]\n", "record.folder: expected a folder"),
        ("[journal]\npath = \"absent/oapwatch.db\"\n", "found no folder"),
        (
            "[[webhook]]\nurl = \"http://127.0.0.1:1\"\nsecret_file = \"absent\"\n",
            "absent",
        ),
        (
            "[fleet]\nurl = \"nats://127.0.0.1:1\"\nsite = \"s\"\nstation = \"a\"\nnkey_file = \"absent.nk\"\n",
            "absent.nk",
        ),
    ] {
        let file = dir.path().join("bad.toml");
        std::fs::write(&file, config).unwrap();
        // The port is taken: a daemon that tried to bind it would say so instead.
        for command in ["run", "check"] {
            let mut run = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
            match command {
                "run" => run.args(["run", "--config"]),
                _ => run.arg("check"),
            };
            let output = run.arg(&file).output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(said.contains(message), "{command} of {config:?} said {said}");
            assert_eq!(output.status.code(), Some(64), "{said}");
        }
    }
}

#[test]
fn a_log_that_nobody_reads_stops_nothing() {
    /// Linux's capacity of a pipe.
    const CAPACITY: usize = 65_536;
    let dir = tempfile::tempdir().unwrap();
    let (unread, mut full) = std::io::pipe().unwrap();
    full.write_all(&[b'x'; CAPACITY]).unwrap();
    let daemon = Daemon::start_logging_to(full.into(), dir.path(), "run", "");
    let seen = daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64());
    daemon.wait_for("/v1/positions", "newer positions", |v| {
        v["frame"].as_u64() > seen["frame"].as_u64()
    });
    daemon.signal("-TERM");
    assert_eq!(daemon.end().0, Some(0));
    drop(unread);
}

#[test]
fn a_bad_file_changes_nothing_on_reload() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = Daemon::start(dir.path(), "");
    daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64());
    std::fs::write(dir.path().join("oapwatch.toml"), "nonsense = 1\n").unwrap();
    daemon.signal("-HUP");
    let seen = daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64());
    daemon.wait_for("/v1/positions", "newer positions", |v| {
        v["frame"].as_u64() > seen["frame"].as_u64()
    });
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0));
    assert!(log.iter().any(|l| l.contains("nothing was changed")), "{log:?}");
}

#[test]
fn what_the_daemon_records_is_reviewed_to_the_same_alert() {
    let dir = tempfile::tempdir().unwrap();
    let record = "[record]\nfolder = \"recordings\"\nsegment_s = 2.0\nbefore_s = 1.0\nafter_s = 0.5\n";
    let daemon = Daemon::start(dir.path(), record);
    let list = daemon.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    let raised = alerts(&list)[0].clone();
    daemon.wait_for("/v1/positions", "frames after the alert", |v| {
        v["frame"].as_u64() > raised["source"]["frame"].as_u64().map(|k| k + 10)
    });
    let id = raised["id"].as_str().unwrap();
    let told = daemon.wait_for(&format!("/v1/alerts/{id}/evidence.json"), "evidence", |v| {
        v["position"].is_u64()
    });
    let position = told["position"].as_u64().unwrap() as usize;
    assert_eq!(told["frames"][position]["index"], raised["source"]["frame"]);
    daemon.signal("-TERM");
    assert_eq!(daemon.end().0, Some(0));

    let file = Path::new(raised["source"]["file"].as_str().unwrap());
    assert!(file.is_file(), "the alert names {}", file.display());
    let evidence = format!("recordings/evidence/{id}.npy");
    assert!(
        file.ends_with(&evidence),
        "the ring's own segment is deleted in time, {evidence} is not: {}",
        file.display()
    );
    let config = dir.path().join("review.toml");
    for recording in ["recordings".to_owned(), format!("recordings/evidence/{id}.npy")] {
        std::fs::write(
            &config,
            format!("[source]\nkind = \"replay\"\nframes = \"{recording}\"\n"),
        )
        .unwrap();
        let review = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
            .args(["review", "--config"])
            .arg(&config)
            .output()
            .unwrap();
        assert!(review.status.success(), "{}", String::from_utf8_lossy(&review.stderr));
        let told = String::from_utf8(review.stdout).unwrap();
        let events: Vec<Value> = told.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let found = events.iter().find(|e| e["event"] == "alert.raised");
        let found = &found.unwrap_or_else(|| panic!("no alert in {recording}: {told}"))["alert"];
        if recording == "recordings" {
            for member in ["id", "kind", "raised_at", "user", "claimed"] {
                assert_eq!(found[member], raised[member], "{member}");
            }
            assert_eq!(found["source"]["frame"], raised["source"]["frame"]);
        }
    }
}

#[test]
fn a_camera_that_was_never_there_is_seen_by_rules_and_in_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let config = "[optics]\njoules_per_count = 1e-9\n[record]\nfolder = \"recordings\"\n[source]\nkind = \"v4l2\"\n\
                  device = \"/dev/no-such-camera\"\nloop = true\n";
    let daemon = Daemon::start(dir.path(), config);
    let list = daemon.wait_for("/v1/alerts", "lost sensor", |v| {
        alerts(v).iter().any(|a| a["kind"] == "sensor_lost")
    });
    for alert in alerts(&list) {
        assert!(alert["source"]["file"].is_null(), "no frame, no file: {alert}");
    }
    let (_, metrics) = daemon.get("/metrics");
    for line in [
        "oapwatch_last_good_frame_timestamp_seconds 0",
        "oapwatch_source_connected 0",
        "oapwatch_alerts_open{kind=\"sensor_lost\"} 1",
        "oapwatch_alerts_raised_total{kind=\"unclaimed_emitter\"} 0",
        "oapwatch_source_faults_total{fault=\"busy\"} 0",
    ] {
        assert!(metrics.lines().any(|l| l == line), "{line} is not in:\n{metrics}");
    }
    assert!(metrics.contains("process_resident_memory_bytes "), "{metrics}");
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0));
    assert!(log.iter().any(|l| l.contains("source.loop has no effect")), "{log:?}");
    assert!(!log.iter().any(|l| l.contains("first usable frame")), "{log:?}");
}

/// The small sister of `make siege`: seven hundred new names every .1 s in the log, and requests that add to them.
#[test]
fn a_flood_of_invented_names_hides_no_eavesdropper() {
    const RATE_HZ: f64 = 10.0;
    let dir = tempfile::tempdir().unwrap();
    let daemon = siege::names::start(dir.path(), RATE_HZ);
    let is_over = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut next = 0;
            while !is_over.load(Ordering::Relaxed) {
                let lines = siege::names::lines(next..next + 700, jiff::Timestamp::now(), siege::names::anywhere);
                siege::names::append(dir.path(), &lines);
                next += 700;
                std::thread::sleep(Duration::from_millis(100));
            }
        });
        // A stop of the flood must come whatever the daemon does.
        let seen = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let posted = siege::names::lines(1_000_000..1_001_000, jiff::Timestamp::now(), siege::names::anywhere);
            let (code, body) = daemon.post("/v1/claims", &posted);
            let answer: Value = serde_json::from_str(&body).unwrap();
            let counted = [&answer["accepted"], &answer["refused"]].map(|n| n.as_u64().unwrap_or(0));
            assert!(matches!(code, 200 | 503), "{code}: {body}");
            assert_eq!(counted[0] + counted[1], 1000, "{body}");
            daemon.wait_for("/v1/positions", "the eavesdropper's first visit", |v| {
                v["frame"].as_u64() > Some(80)
            })
        }));
        is_over.store(true, Ordering::Relaxed);
        seen.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    let frame = seen["frame"].as_u64().unwrap();
    let alerted = siege::names::times_to_alert(&daemon, RATE_HZ, 0, frame);
    assert!(matches!(alerted[..], [Some(s), ..] if s <= 1.0), "{alerted:?}");
    let invented = seen["emitters"].as_array().unwrap().iter().find(|e| {
        let user = e["user"].as_str().unwrap_or_default();
        e["status"] == "verified" && user.starts_with("invented")
    });
    assert_eq!(invented, None);
    let flooded = daemon.get("/v1/alerts?kind=claims_flooded").1;
    let flooded: Value = serde_json::from_str(&flooded).unwrap();
    assert_eq!(alerts(&flooded).len(), 1, "{flooded}");
    let evidence = &alerts(&flooded)[0]["evidence"];
    assert!(
        evidence["users"].as_u64() <= evidence["max_users"].as_u64(),
        "{evidence}"
    );
}
