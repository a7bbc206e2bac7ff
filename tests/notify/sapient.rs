//! SAPIENT against a receiver in this process and against the SAPIENT messages' own validation.

use std::io::{BufRead, BufReader};
use std::process::{Command as Program, Stdio};
use std::sync::Arc;
use std::time::Duration;

use oapwatch::api::{Acknowledged, Command};
use oapwatch::export::Context;
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{Channel, EndpointState};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;

use super::counterparts::installed;
use super::exports::load;
use super::positions::{sending, snapshot};
use super::sender::{event, start, until};

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
