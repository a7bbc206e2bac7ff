//! A server on board of an access point that is a leaf node of the fleet's, and MQTT clients: the shipped configs with their options on.

use std::ffi::OsString;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use serde_json::Value;

use crate::fleet_measured::scene;
use crate::fleet_permissions::{self, Key};
use crate::journals::agree;
use crate::nats::{Server, station_of};
use crate::port::free_port;
use crate::process::alerts;

const CA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tls/ca.pem");

/// A line that begins with # and no space is an option that is off.
fn options_on(text: &str) -> String {
    let on = |line: &str| match line.trim_start().strip_prefix('#') {
        Some(option) if !option.starts_with(' ') => format!("{option}\n"),
        _ => format!("{line}\n"),
    };
    text.lines().map(on).collect()
}

/// The fleet's server and the one on board, with their options on.
struct Servers {
    port: u16,
    mqtt: u16,
    fleet: Server,
    on_board: Server,
}

fn start(dir: &Path, ap7: &Key, hub: &Key) -> Option<Servers> {
    let (leaf, mqtt) = (free_port(), free_port());
    let file = dir.join("nats-server.conf");
    let fleet = Server::start_with(None, |port| {
        let text = options_on(&fleet_permissions::config(dir, port, ap7, hub));
        assert!(text.contains("0.0.0.0:7422") && text.contains("0.0.0.0:8883"), "{text}");
        let text = text.replace("0.0.0.0:7422", &format!("127.0.0.1:{leaf}"));
        std::fs::write(&file, text.replace("0.0.0.0:8883", &format!("127.0.0.1:{mqtt}"))).unwrap();
        vec!["-c".into(), file.into()]
    })?;
    let on_board = dir.join("nats-leaf.conf");
    let on_board = Server::start_with(None, |port| {
        let shipped = include_str!("../../deploy/nats-leaf.conf");
        let text = shipped.replace("127.0.0.1:4222\"\nserver", &format!("127.0.0.1:{port}\"\nserver"));
        let text = text.replace("hub.example:7422", &format!("127.0.0.1:{leaf}"));
        std::fs::write(&on_board, text.replace("/etc/nats/server-cert.pem", CA)).unwrap();
        vec![OsString::from("-c"), on_board.into()]
    })?;
    let port = fleet.port;
    Some(Servers {
        port,
        mqtt,
        fleet,
        on_board,
    })
}

/// How many positions a program on board hears in two seconds.
fn heard_on_board(port: u16) -> usize {
    let listening = async move {
        let client = async_nats::connect(format!("127.0.0.1:{port}")).await.unwrap();
        let messages = client.subscribe("oapwatch.harbour.ap7.positions").await.unwrap();
        let end = tokio::time::sleep(Duration::from_secs(2));
        messages.take_until(end).count().await
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(listening)
}

#[test]
fn alerts_published_on_board_reach_the_hub_once_each_after_a_cut() {
    let dir = tempfile::tempdir().unwrap();
    let [ap7, hub] = ["ap7", "hub"].map(|name| Key::new(dir.path().join(format!("{name}.nkey"))));
    let Some(mut servers) = start(dir.path(), &ap7, &hub) else {
        return;
    };
    let hub = fleet_permissions::start(dir.path(), "fleet", "", servers.port, &hub);
    let station = station_of(dir.path(), "ap7", &scene(dir.path()), servers.on_board.port, "");
    let list = hub.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    let id = alerts(&list)[0]["id"]
        .as_str()
        .unwrap()
        .strip_prefix("harbour.ap7.")
        .unwrap()
        .to_owned();

    servers.fleet.end();
    let path = format!("/v1/alerts/{id}/acknowledge");
    for method in ["POST", "DELETE"].iter().cycle().take(40) {
        assert_eq!(station.send(method, &path, "", "").0, 200);
    }
    assert!(
        heard_on_board(servers.on_board.port) > 0,
        "programs on board hear it without the link"
    );
    let file = dir.path().join("nats-server.conf");
    servers.fleet = Server::start_with(Some(servers.port), |_| vec!["-c".into(), file.into()]).unwrap();
    let all = agree(dir.path(), "fleet-0", "ap7", Duration::from_secs(60));
    assert!(all > 40, "{all} events");
}

#[test]
fn mqtt_clients_hear_what_stations_publish_and_may_not_publish() {
    if Command::new("mosquitto_sub")
        .arg("--help")
        .stdout(Stdio::null())
        .status()
        .is_err()
    {
        assert!(std::env::var_os("CI").is_none(), "mosquitto_sub is missing");
        eprintln!("skipped: mosquitto_sub is missing; `make setup-test` installs it");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let [ap7, hub] = ["ap7", "hub"].map(|name| Key::new(dir.path().join(format!("{name}.nkey"))));
    let Some(servers) = start(dir.path(), &ap7, &hub) else {
        return;
    };
    // The hub makes the stream that the server stores alerts in.
    let hub = fleet_permissions::start(dir.path(), "fleet", "", servers.port, &hub);
    let as_viewer = |program: &str, more: &[&str]| {
        let mut command = Command::new(program);
        command.args([
            "-h",
            "127.0.0.1",
            "-p",
            &servers.mqtt.to_string(),
            "--cafile",
            CA,
            "--insecure",
        ]);
        command
            .args(["-u", "viewer", "-P", "REPLACEWITHAPASSWORDOFTHEVIEWER", "-q", "1"])
            .args(more);
        command
    };
    let hearing = |topic: &str| {
        let mut command = as_viewer("mosquitto_sub", &["-t", topic, "-C", "1", "-W", "20"]);
        command.stdout(Stdio::piped()).spawn().unwrap()
    };
    let (alert, positions) = (hearing("oapwatch/+/+/alert"), hearing("oapwatch/harbour/ap7/positions"));
    let _station = station_of(dir.path(), "ap7", &scene(dir.path()), servers.on_board.port, "");
    for (client, key) in [(alert, "event"), (positions, "emitters")] {
        let output = client.wait_with_output().unwrap();
        let message: Value = serde_json::from_slice(&output.stdout).expect("a message within 20 s");
        assert_eq!(message["station"], "ap7");
        assert!(!message[key].is_null(), "{message}");
    }
    let _ = as_viewer("mosquitto_pub", &["-t", "oapwatch/harbour/ap9/health", "-m", "{}"]).status();
    // What a liar says would be shown as refused.
    let end = Instant::now() + Duration::from_secs(2);
    while Instant::now() < end {
        assert!(!hub.get("/v1/stations").1.contains("\"ap9\""));
        std::thread::sleep(Duration::from_millis(200));
    }
}
