//! Positions and alerts to systems that know latitudes: Cursor on Target and SAPIENT, against receivers in this process and against
//! taky and the SAPIENT messages' own validation.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use oapwatch::api::{self};
use oapwatch::export::{Context, Export};
use oapwatch::monitor::{AlertEventKind, AlertKind, Report};
use oapwatch::notify::Clock;
use oapwatch::optics;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpStream, UdpSocket};

use super::counterparts::{installed, run};
use super::exports::{context, load};
use super::port::free_port;
use super::sender::{Daemon, event, on_disk, start, until};

/// A verified user at (100, 200) m with standard deviations of 2 and 1 m, and a stranger at (-50, 0) m.
pub fn snapshot() -> api::Snapshot {
    let emitter = |track: u64, x_m: f64, y_m: f64, user: Option<&str>, status: &str| {
        let emitter = json!({
            "track": track, "x_m": x_m, "y_m": y_m, "cov_m2": [[4.0, 0.0], [0.0, 1.0]], "energy_j": 0.008,
            "user": user, "status": status, "flags": [],
        });
        serde_json::from_value(emitter).unwrap()
    };
    api::Snapshot {
        pose: None,
        report: Report {
            time: start(),
            frame: 7,
            emitters: vec![
                emitter(1, 100.0, 200.0, Some("u <1>"), "verified"),
                emitter(2, -50.0, 0.0, None, "unclaimed"),
            ],
            unseen: Vec::new(),
            events: Vec::new(),
            claims: Vec::new(),
        },
        frame: None,
        camera: Arc::new(optics::Config::default().camera().unwrap()),
        status: api::Status {
            version: "0",
            started_at: start(),
            source: api::SourceStatus {
                kind: "simulator".into(),
                state: api::SourceState::Running,
                rate_hz: 10.0,
                last_good_frame_at: Some(start()),
                fault: None,
            },
            frames: api::FrameCounts::default(),
            latency: api::Latency::default(),
            claims: api::ClaimsStatus::default(),
            journal: api::JournalStatus {
                healthy: true,
                place: "memory".into(),
                fault: None,
            },
            webhooks: Vec::new(),
            estimator: "ml".into(),
            fit: None,
            alerts_open: BTreeMap::new(),
            field_of_view_m: [125.0, 125.0],
            view: None,
            stations: Vec::new(),
        },
    }
}

/// An export with the sending half of the daemon and a frame that was published.
pub fn sending(dir: &std::path::Path, lines: &str) -> (Daemon, Arc<dyn oapwatch::export::Updates>, Context) {
    let Export { endpoint, updates } = load(lines).unwrap();
    let daemon = Daemon::sending_to(&on_disk(dir), vec![endpoint], Clock::wall());
    let context = context(&daemon);
    context.feed.publish(snapshot());
    (daemon, updates.unwrap(), context)
}

fn attribute<'a>(event: &'a str, name: &str) -> &'a str {
    let after = event
        .split_once(&format!(" {name}=\""))
        .unwrap_or_else(|| panic!("{name} in {event}"))
        .1;
    after.split_once('"').unwrap().0
}

#[test]
fn without_an_origin_there_is_no_latitude() {
    let config = toml::from_str("kind = \"cot\"\naddress = \"udp://239.2.3.1:6969\"").unwrap();
    let error = oapwatch::export::load(&[config], &[], &oapwatch::geo::Config::default()).unwrap_err();
    assert!(error.to_string().contains("[world] origin"), "{error}");
    let error = load("kind = \"sapient\"\naddress = \"tcp://node\"").unwrap_err();
    assert!(error.contains("tcp://HOST:PORT"), "{error}");
    let error = load("kind = \"cot\"\naddress = \"udp://a\"\ninterval_s = 0.0").unwrap_err();
    assert!(error.contains("interval_s: expected 0.1 to 3600"), "{error}");
}

#[tokio::test]
async fn a_cot_event_has_type_by_verdict_and_ce_from_the_covariance() {
    let dir = tempfile::tempdir().unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let lines = format!(
        "kind = \"cot\"\nstation = \"ap7\"\naddress = \"udp://{}\"",
        socket.local_addr().unwrap()
    );
    let (daemon, updates, context) = sending(dir.path(), &lines);
    let mut bytes = [0; 65536];
    let mut next = async || {
        let length = tokio::time::timeout(Duration::from_secs(20), socket.recv(&mut bytes));
        String::from_utf8(bytes_of(length.await.unwrap().unwrap(), &bytes)).unwrap()
    };
    updates.round(&context).await.unwrap();
    let known = next().await;
    assert_eq!(attribute(&known, "type"), "a-f-G");
    assert_eq!(attribute(&known, "uid"), "oapwatch.ap7.beam-1");
    assert_eq!(attribute(&known, "callsign"), "u &lt;1&gt;");
    assert_eq!(
        (attribute(&known, "ce"), attribute(&known, "le")),
        ("2.00", "9999999.00")
    );
    let degrees = |name: &str| attribute(&known, name).parse::<f64>().unwrap();
    // One degree of latitude at 48° is 111.20 km, one of longitude 74.63 km, both 520 m lower.
    assert!((degrees("lat") - 48.0 - 200.0 / 111_209.0).abs() < 1e-6, "{known}");
    assert!((degrees("lon") - 11.0 - 100.0 / 74_634.0).abs() < 1e-6, "{known}");
    let at = |name: &str| attribute(&known, name).parse::<jiff::Timestamp>().unwrap();
    assert_eq!(at("stale").duration_since(at("start")).as_secs(), 5);
    let stranger = next().await;
    assert_eq!(
        (attribute(&stranger, "type"), attribute(&stranger, "callsign")),
        ("a-s-G", "beam 2")
    );
    // The same frame is not sent twice.
    updates.round(&context).await.unwrap();

    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter)]);
    let raised = next().await;
    assert_eq!(attribute(&raised, "uid"), "oapwatch.ap7.alert.a");
    assert_eq!(attribute(&raised, "type"), "a-s-G");
    daemon.record(&[event(AlertEventKind::Cleared, "a", AlertKind::UnclaimedEmitter)]);
    let cleared = next().await;
    assert_eq!(attribute(&cleared, "type"), "t-x-d-d");
    assert!(cleared.contains("<link uid=\"oapwatch.ap7.alert.a\""), "{cleared}");
    daemon.record(&[{
        let mut lost = event(AlertEventKind::Raised, "b", AlertKind::SensorLost);
        (lost.alert.x_m, lost.alert.y_m) = (None, None);
        lost
    }]);
    let lost = next().await;
    assert_eq!(
        (attribute(&lost, "type"), attribute(&lost, "ce")),
        ("b-m-p-s-m", "9999999.00")
    );
    let outcome = daemon.notifier.test(&daemon.status().name).await.unwrap();
    assert!(outcome.delivered, "{outcome:?}");
    assert!(next().await.contains("a test event"));
    daemon.stop().await;
}

fn bytes_of(length: usize, bytes: &[u8]) -> Vec<u8> {
    bytes[..length].to_vec()
}

#[tokio::test]
async fn taky_routes_our_events_to_its_other_clients() {
    let Some(taky) = installed("taky", &["target/systems/bin/taky"]) else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let config = format!(
        "[taky]\nhostname=localhost\nnode_id=TEST\nbind_ip=127.0.0.1\nredis=false\nroot_dir={dir}\n[cot_server]\nport={port}\n\
         [dp_server]\nupload_path={dir}\n[ssl]\nenabled=false\n",
        dir = dir.path().display()
    );
    let path = dir.path().join("taky.conf");
    std::fs::write(&path, config).unwrap();
    let _taky = run(&taky, &["-c", path.to_str().unwrap()]);
    until(|| std::net::TcpStream::connect(("127.0.0.1", port)).is_ok()).await;
    let mut viewer = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
    let me = format!(
        "<event version=\"2.0\" uid=\"viewer\" type=\"a-f-G-U-C\" how=\"m-g\" time=\"{now}\" start=\"{now}\" stale=\"{later}\">\
         <point lat=\"48\" lon=\"11\" hae=\"0\" ce=\"1\" le=\"1\"/><detail><contact callsign=\"viewer\"/>\
         <__group name=\"Cyan\" role=\"HQ\"/><takv version=\"1\" platform=\"test\" os=\"1\" device=\"t\"/></detail></event>",
        now = jiff::Timestamp::now(),
        later = jiff::Timestamp::now() + jiff::SignedDuration::from_mins(5),
    );
    viewer.write_all(me.as_bytes()).await.unwrap();
    let lines = format!("kind = \"cot\"\nstation = \"ap7\"\naddress = \"tcp://127.0.0.1:{port}\"");
    let (daemon, updates, context) = sending(dir.path(), &lines);
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter)]);
    let mut heard = String::new();
    let mut bytes = [0; 65536];
    let expected = ["oapwatch.ap7.beam-1", "oapwatch.ap7.beam-2", "oapwatch.ap7.alert.a"];
    // taky routes to clients that it knows by then: a frame more for each read.
    for round in 0..200 {
        if expected.iter().all(|uid| heard.contains(uid)) {
            break;
        }
        assert!(round < 199, "heard only {heard}");
        context.feed.publish(snapshot());
        updates.round(&context).await.unwrap();
        if let Ok(read) = tokio::time::timeout(Duration::from_millis(100), viewer.read(&mut bytes)).await {
            heard += std::str::from_utf8(&bytes[..read.unwrap()]).unwrap();
        }
    }
    assert!(
        heard.contains("type=\"a-f-G\"") && heard.contains("type=\"a-s-G\""),
        "{heard}"
    );
    daemon.stop().await;
}
