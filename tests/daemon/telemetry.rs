//! An autopilot's poses in a running daemon.

use std::collections::BTreeMap;
use std::net::UdpSocket;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::Value;

use super::port::free_port;
use super::process::{Daemon, alerts};

fn bytes(hex: &str) -> Vec<u8> {
    let hex = hex.trim();
    let byte = |k: usize| u8::from_str_radix(&hex[2 * k..2 * k + 2], 16).unwrap();
    (0..hex.len() / 2).map(byte).collect()
}

#[test]
fn an_autopilot_s_poses_are_used_shown_and_missed() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let platform = format!("[platform]\nkind = \"mavlink\"\nendpoint = \"udpin:127.0.0.1:{port}\"\n");
    let config = format!("{platform}[record]\nfolder = \"recordings\"\n");
    let daemon = Daemon::start(dir.path(), &config);
    let before = daemon.wait_for("/v1/pose", "a status", |v| v["source"] == "mavlink");
    assert!(before["pose"].is_null(), "{before}");

    // A heartbeat of system 7 and one pose, again and again, five times at least, until the pose is seen.
    let is_flying = Arc::new(AtomicBool::new(true));
    let flying = is_flying.clone();
    let sender = std::thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let frames = [
            include_str!("../platform/heartbeat.hex"),
            include_str!("../platform/odometry.hex"),
        ]
        .map(bytes);
        for round in 0.. {
            if round >= 5 && !flying.load(Ordering::Relaxed) {
                break;
            }
            for frame in &frames {
                let _ = socket.send_to(frame, ("127.0.0.1", port));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let seen = daemon.wait_for("/v1/pose", "a pose", |v| v["pose"].is_object());
    let pose = &seen["pose"];
    assert_eq!(
        [&pose["x_m"], &pose["y_m"], &pose["z_m"], &pose["heading_deg"]],
        [20.0, 10.0, 100.0, 0.0],
        "{seen}"
    );
    // The autopilot falls silent.
    is_flying.store(false, Ordering::Relaxed);
    sender.join().unwrap();
    daemon.wait_for("/v1/alerts?kind=pose_lost", "that poses are lost", |v| {
        !alerts(v).is_empty()
    });
    daemon.wait_for("/v1/pose", "that the pose is old", |v| {
        v["is_lost"] == true && v["pose"]["age_s"].as_f64() > Some(1.0)
    });
    let metrics = daemon.get("/metrics").1;
    let lost = daemon.wait_for("/v1/alerts", "alerts", |_| true);
    daemon.signal("-TERM");
    assert_eq!(daemon.end().0, Some(0));
    for expected in [
        "oapwatch_poses_total",
        "oapwatch_pose_refused_total{reason=\"duplicate\"}",
        "oapwatch_pose_age_seconds",
    ] {
        assert!(
            metrics.lines().any(|l| l.starts_with(expected) && !l.ends_with(" 0")),
            "{expected}: {metrics}"
        );
    }
    // When poses are lost, and how far the platform may have gone since, hangs on each pose and on when it came.
    let told = raised(alerts(&lost).iter());
    assert!(told.keys().any(|(_, id)| id.starts_with("pose_lost")), "{lost}");
    let last = told.keys().map(|(frame, _)| *frame).max();
    let mut reviewed = review(dir.path(), &platform);
    reviewed.retain(|(frame, _), _| Some(*frame) <= last);
    assert_eq!(reviewed, told);
    let mut level = review(dir.path(), "");
    level.retain(|(_, id), _| id.starts_with("pose_lost"));
    assert!(level.is_empty(), "{level:?}");
}

/// Evidence of alerts by frame and id.
type Story = BTreeMap<(u64, String), Value>;

fn raised<'a>(alerts: impl Iterator<Item = &'a Value>) -> Story {
    let story = alerts.map(|alert| {
        let frame = alert["source"]["frame"].as_u64().unwrap();
        let id = alert["id"].as_str().unwrap().to_owned();
        ((frame, id), alert["evidence"].clone())
    });
    story.collect()
}

/// What a review of the recording raises.
fn review(dir: &Path, platform: &str) -> Story {
    let config = dir.join("review.toml");
    let source = "[source]\nkind = \"replay\"\nframes = \"recordings\"\n";
    std::fs::write(&config, format!("{source}{platform}")).unwrap();
    let review = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(["review", "--config"])
        .arg(&config)
        .output()
        .unwrap();
    assert!(review.status.success(), "{}", String::from_utf8_lossy(&review.stderr));
    let events = String::from_utf8(review.stdout).unwrap();
    let events: Vec<Value> = events.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of_raised = events.iter().filter(|e| e["event"] == "alert.raised");
    raised(of_raised.map(|e| &e["alert"]))
}
