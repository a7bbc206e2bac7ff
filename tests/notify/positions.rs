//! Positions and alerts to systems that know latitudes: Cursor on Target and SAPIENT, against receivers in this process and against
//! taky and the SAPIENT messages' own validation.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::process::{Command as Program, Stdio};
use std::sync::Arc;
use std::time::Duration;

use oapwatch::api::{self, Acknowledged, Command};
use oapwatch::export::{Context, Export};
use oapwatch::monitor::{AlertEventKind, AlertKind, Report};
use oapwatch::notify::{Channel, Clock, EndpointState};
use oapwatch::optics;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::mpsc;

use super::counterparts::{free_port, installed, run};
use super::exports::{context, load};
use super::sender::{Daemon, event, on_disk, start, until};

/// A verified user at (100, 200) m with standard deviations of 2 and 1 m, and a stranger at (-50, 0) m.
fn snapshot() -> api::Snapshot {
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
fn sending(dir: &std::path::Path, lines: &str) -> (Daemon, Arc<dyn oapwatch::export::Updates>, Context) {
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

/// Acknowledges what it is asked to, like the compute thread, and tells of it.
fn acknowledging(context: &mut Context) -> mpsc::UnboundedReceiver<(String, Option<String>)> {
    let (commands, mut orders) = mpsc::channel(1);
    let (told, tell) = mpsc::unbounded_channel();
    context.commands = commands;
    tokio::spawn(async move {
        while let Some(command) = orders.recv().await {
            if let Command::Acknowledge { id, by, reply, .. } = command {
                let alert = event(AlertEventKind::Acknowledged, &id, AlertKind::UnclaimedEmitter).alert;
                let _ = reply.send(Acknowledged::Done(Box::new(alert)));
                let _ = told.send((id, by));
            }
        }
    });
    tell
}

#[tokio::test]
async fn a_sapient_node_says_what_the_standard_allows_and_is_acknowledged() {
    let Some(python) = installed("sapient-pydantic", &["target/systems/bin/python"]) else {
        return;
    };
    let script = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/notify/sapient_node.py");
    let mut node = Program::new(python).arg(script).stdout(Stdio::piped()).spawn().unwrap();
    let (said, mut lines) = mpsc::unbounded_channel::<Value>();
    let out = node.stdout.take().unwrap();
    std::thread::spawn(move || {
        for line in BufReader::new(out).lines().map_while(Result::ok) {
            if said.send(serde_json::from_str(&line).unwrap()).is_err() {
                return;
            }
        }
    });
    let port = lines.recv().await.unwrap()["port"].clone();
    let dir = tempfile::tempdir().unwrap();
    let lines_of = format!("kind = \"sapient\"\nstation = \"ap7\"\naddress = \"tcp://127.0.0.1:{port}\"");
    let (daemon, updates, mut context) = sending(dir.path(), &lines_of);
    let mut acknowledged = acknowledging(&mut context);
    let mut next = async |kind: &str| {
        let line = tokio::time::timeout(Duration::from_secs(20), lines.recv())
            .await
            .unwrap()
            .unwrap();
        assert_eq!((&line["kind"], &line["fault"]), (&json!(kind), &Value::Null), "{line}");
        line
    };
    updates.round(&context).await.unwrap();
    next("registration").await;
    assert_eq!(next("status_report").await["system"], 1);
    let known = next("detection_report").await;
    assert_eq!(
        (&known["id"], &known["object_info"]["verdict"]),
        (&json!("u <1>"), &json!("verified"))
    );
    let degrees = |k: usize| known["location"][k].as_f64().unwrap();
    assert!(
        (degrees(0) - 11.0 - 100.0 / 74_634.0).abs() < 1e-6 && (degrees(1) - 48.0 - 200.0 / 111_209.0).abs() < 1e-6
    );
    // East 2 m, north 1 m, in degrees.
    let error = |k: usize| known["error"][k].as_f64().unwrap();
    assert!(
        (error(0) * 74_500.0 - 2.0).abs() < 0.02 && (error(1) * 111_209.0 - 1.0).abs() < 0.01,
        "{known}"
    );
    next("detection_report").await;

    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter)]);
    let active = next("alert").await;
    assert_eq!(
        (&active["status"], &active["description"]),
        (&json!(1), &json!("unclaimed emitter at x 1.50 m, y -2.50 m"))
    );
    // The node's acknowledgement reaches the compute thread with the next round, and the audit log.
    let (id, by) = loop {
        updates.round(&context).await.unwrap();
        if let Ok(found) = acknowledged.try_recv() {
            break found;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    };
    assert!(
        id == "a"
            && by
                .as_deref()
                .is_some_and(|by| by.starts_with("sapient ") && by.len() == 44),
        "{by:?}"
    );
    daemon.record(
        &[AlertEventKind::Acknowledged, AlertEventKind::Cleared]
            .map(|kind| event(kind, "a", AlertKind::UnclaimedEmitter)),
    );
    assert_eq!(next("alert").await["status"], 2);
    assert_eq!(next("alert").await["status"], 5);
    daemon.journal.settled().await;
    let audited = daemon.journal.audit_log(None, 10).unwrap();
    assert!(
        audited
            .iter()
            .any(|row| row.entry.target.as_deref() == Some("a") && row.entry.actor == by),
        "{audited:?}"
    );
    node.kill().unwrap();
    node.wait().unwrap();
    daemon.stop().await;
}

/// One message of the wire by hand: the length, then `content` as field `tag` of the envelope.
fn framed(tag: u8, content: &[u8]) -> Vec<u8> {
    let mut message = vec![tag << 3 | 2, content.len() as u8];
    message.extend_from_slice(content);
    let mut bytes = (message.len() as u32).to_le_bytes().to_vec();
    bytes.extend(message);
    bytes
}

/// Reads our registration and accepts it.
async fn accept(listener: &TcpListener) -> TcpStream {
    let (mut stream, _) = listener.accept().await.unwrap();
    let length = stream.read_u32_le().await.unwrap();
    let mut registration = vec![0; length as usize];
    stream.read_exact(&mut registration).await.unwrap();
    stream.write_all(&framed(5, &[0x08, 0x01])).await.unwrap();
    stream
}

#[tokio::test]
async fn a_lying_sapient_side_costs_its_own_connection_only() {
    let dir = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let lines = format!(
        "kind = \"sapient\"\nname = \"node\"\ntimeout_s = 5.0\naddress = \"tcp://{}\"",
        listener.local_addr().unwrap()
    );
    let (daemon, updates, mut context) = sending(dir.path(), &lines);
    let mut acknowledged = acknowledging(&mut context);
    let (round, mut stream) = tokio::join!(updates.round(&context), accept(&listener));
    round.unwrap();
    let (mut reading, mut writing) = stream.split();
    // A million acknowledgements of alerts that do not exist, and as many that are no messages.
    let mut unknown = vec![0x0a, 26];
    unknown.extend_from_slice(b"01ARYZ6S41TSV4RRFFQ69G5FAV");
    unknown.extend_from_slice(&[0x28, 0x01]);
    let mut flood = framed(11, &unknown);
    flood.extend([2, 0, 0, 0, 0xff, 0xff]);
    let flood = flood.repeat(1000);
    let flooding = async {
        for _ in 0..1000 {
            writing.write_all(&flood).await.unwrap();
        }
    };
    let mut sink = vec![0; 1 << 16];
    let others = async {
        daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter)]);
        until(|| daemon.status().sent == 1).await;
    };
    tokio::join!(flooding, others);
    assert!(reading.read(&mut sink).await.unwrap() > 0);
    assert!(acknowledged.try_recv().is_err());
    assert_eq!(daemon.status().state, EndpointState::Working);
    // A message that is announced as four gigabytes ends the connection; the next one is registered anew.
    writing.write_all(&[0xff, 0xff, 0xff, 0xff]).await.unwrap();
    while reading.read(&mut sink).await.unwrap_or(0) > 0 {}
    drop(stream);
    context.feed.publish(snapshot());
    let (round, _stream) = tokio::join!(
        async {
            // What was written while the connection ended may have been lost with it.
            while updates.round(&context).await.is_err() {}
        },
        accept(&listener)
    );
    let () = round;
    // A side that refuses us is told apart from one that is not there.
    let refusing = async {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut sink = [0; 4096];
        let _ = stream.read(&mut sink).await.unwrap();
        stream
            .write_all(&framed(5, &[0x08, 0x00, 0x1a, 2, b'n', b'o']))
            .await
            .unwrap();
        let _ = stream.read(&mut sink).await;
    };
    let other = load(&lines).unwrap();
    let recorded = oapwatch::notify::test_event(start());
    let message = oapwatch::notify::Message {
        id: "msg",
        event: &recorded,
        is_test: true,
        now: start(),
    };
    let channel: Arc<dyn Channel> = other.endpoint.channel.clone();
    let (verdict, ()) = tokio::join!(channel.deliver(message), refusing);
    let said = format!("{verdict:?}");
    assert!(said.contains("refuses our registration: no"), "{said}");
    daemon.stop().await;
}
