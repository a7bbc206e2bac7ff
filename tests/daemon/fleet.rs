//! Stations, a real NATS server and the hub, killed while alerts flow.

use std::collections::BTreeMap;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::process::{Daemon, alerts};

/// A NATS server with JetStream; killed when dropped.
struct Server {
    child: Child,
    port: u16,
}

impl Server {
    /// `None` where there is no nats-server; never in CI.
    fn start(dir: &Path, port: Option<u16>) -> Option<Self> {
        let port = port.unwrap_or_else(|| TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port());
        let child = Command::new("nats-server")
            .args(["-js", "-a", "127.0.0.1", "-p", &port.to_string(), "-sd"])
            .arg(dir.join("nats"))
            .stderr(Stdio::null())
            .spawn();
        let child = match child {
            Ok(child) => child,
            Err(error) if std::env::var_os("CI").is_none() => {
                eprintln!("skipped: nats-server cannot be started ({error}); `make setup-test` installs it");
                return None;
            }
            Err(error) => panic!("nats-server: {error}"),
        };
        let end = Instant::now() + Duration::from_secs(20);
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(Instant::now() < end, "nats-server does not listen");
            std::thread::sleep(Duration::from_millis(20));
        }
        Some(Self { child, port })
    }

    /// Kills it as the kernel would; gives the port for the next one.
    fn kill(mut self) -> u16 {
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.port
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn station(dir: &Path, name: &str, scene: &str, port: u16) -> Daemon {
    let dir = dir.join(name);
    std::fs::create_dir_all(&dir).unwrap();
    let scene = format!("{}/config/scenes/{scene}.toml", env!("CARGO_MANIFEST_DIR"));
    let config = format!(
        "[source]\nkind = \"simulator\"\nscene = {scene:?}\n[journal]\npath = \"journal.db\"\n\
         [fleet]\nurl = \"nats://127.0.0.1:{port}\"\nsite = \"harbour\"\nstation = {name:?}\n"
    );
    Daemon::start(&dir, &config)
}

fn hub(dir: &Path, port: u16) -> Daemon {
    let dir = dir.join("hub");
    std::fs::create_dir_all(&dir).unwrap();
    let config =
        format!("[fleet]\nurl = \"nats://127.0.0.1:{port}\"\nlost_after_s = 2.0\n[journal]\npath = \"journal.db\"\n");
    Daemon::start_as(&dir, "fleet", &config)
}

/// The events of each alert in a journal, in order; `prefix` is what the hub puts before a station's ids.
fn histories(journal: &Path, prefix: &str) -> BTreeMap<String, Vec<String>> {
    let db = rusqlite::Connection::open_with_flags(journal, rusqlite::OpenFlags::SQLITE_OPEN_READ_ONLY).unwrap();
    let mut rows = db.prepare("SELECT alert, body FROM event ORDER BY seq").unwrap();
    let row = |row: &rusqlite::Row| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?));
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (id, body) in rows.query_map([], row).unwrap().map(Result::unwrap) {
        let event: Value = serde_json::from_str(&body).unwrap();
        if let Some(own) = id.strip_prefix(prefix) {
            let name = event["event"].as_str().unwrap().to_owned();
            found.entry(own.to_owned()).or_default().push(name);
        }
    }
    found
}

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
    let end = Instant::now() + Duration::from_secs(20);
    loop {
        let at_station = histories(&dir.path().join("ap7/journal.db"), "");
        let at_hub = histories(&dir.path().join("hub/journal.db"), "harbour.ap7.");
        if !at_station.is_empty() && at_station == at_hub {
            break;
        }
        assert!(Instant::now() < end, "{at_station:?}\nat the hub: {at_hub:?}");
        std::thread::sleep(Duration::from_millis(200));
    }
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
