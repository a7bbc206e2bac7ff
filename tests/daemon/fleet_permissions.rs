//! The NATS server's config that is shipped: TLS, NKeys, and each station under its own subjects only.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use async_nats::{ConnectOptions, Event};
use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::nats::Server;
use crate::process::{Daemon, alerts};

const CA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tls/ca.pem");

/// A key that the program made.
pub struct Key {
    file: PathBuf,
    public: String,
}

impl Key {
    pub fn new(file: PathBuf) -> Self {
        let nkey = || {
            Command::new(env!("CARGO_BIN_EXE_oapwatch"))
                .arg("nkey")
                .arg(&file)
                .output()
                .unwrap()
        };
        let made = nkey();
        let public = String::from_utf8(made.stdout).unwrap().trim().to_owned();
        assert!(made.status.success() && public.starts_with('U'), "{public}");
        let mode = std::fs::metadata(&file).unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0, "{mode:o}");
        assert_eq!(nkey().status.code(), Some(2), "a key in use is not replaced");
        Self { file, public }
    }

    fn seed(&self) -> String {
        std::fs::read_to_string(&self.file).unwrap().trim().to_owned()
    }
}

/// The shipped config with keys, certificates and folders that are here.
pub fn config(dir: &Path, port: u16, ap7: &Key, hub: &Key) -> String {
    let tls = format!("{}/tests/data/tls", env!("CARGO_MANIFEST_DIR"));
    let store = dir.join("nats").display().to_string();
    let mut text = include_str!("../../deploy/nats-server.conf").to_owned();
    for (shipped, here) in [
        ("0.0.0.0:4222", format!("127.0.0.1:{port}")),
        ("/etc/nats/server-cert.pem", format!("{tls}/server.pem")),
        ("/etc/nats/server-key.pem", format!("{tls}/server.key")),
        ("/var/lib/nats", store),
        ("UREPLACEWITHTHEPUBLICKEYOFAP7", ap7.public.clone()),
        ("UREPLACEWITHTHEPUBLICKEYOFTHEHUB", hub.public.clone()),
    ] {
        assert_eq!(text.matches(shipped).count(), 1, "{shipped}");
        text = text.replace(shipped, &here);
    }
    text
}

/// A config that speaks for `station`, or the hub's, with `key`.
pub fn start(dir: &Path, command: &str, names: &str, port: u16, key: &Key) -> Daemon {
    let dir = dir.join(format!("{command}-{}", names.len()));
    std::fs::create_dir_all(&dir).unwrap();
    let nkey = &key.file;
    let config = format!(
        "[journal]\npath = \"journal.db\"\n[fleet]\nurl = \"tls://127.0.0.1:{port}\"\nca_file = {CA:?}\n\
         nkey_file = {nkey:?}\n{names}\n"
    );
    Daemon::start_as(&dir, command, &config)
}

/// Publishes a station's health with ap7's key; gives what the server objects to within two seconds.
async fn objection(port: u16, key: &Key, station: &str) -> Option<String> {
    let (events, mut heard) = mpsc::unbounded_channel();
    let options = ConnectOptions::with_nkey(key.seed())
        .add_root_certificates(CA.into())
        .event_callback(move |event| {
            if let Event::ServerError(error) = event {
                let _ = events.send(error.to_string());
            }
            std::future::ready(())
        });
    let client = options.connect(format!("tls://127.0.0.1:{port}")).await.unwrap();
    let body = json!({
        "version": 1, "site": "harbour", "station": station, "time": jiff::Timestamp::now(), "status": null, "alerts_waiting": 0,
    });
    let subject = format!("oapwatch.harbour.{station}.health");
    client.publish(subject, body.to_string().into()).await.unwrap();
    client.flush().await.unwrap();
    tokio::time::timeout(Duration::from_secs(2), heard.recv())
        .await
        .ok()
        .flatten()
}

#[test]
fn with_the_shipped_config_a_station_speaks_for_itself_only() {
    let dir = tempfile::tempdir().unwrap();
    let [ap7, hub] = ["ap7", "hub"].map(|name| Key::new(dir.path().join(format!("{name}.nkey"))));
    let file = dir.path().join("nats-server.conf");
    let Some(server) = Server::start_with(None, |port| {
        std::fs::write(&file, config(dir.path(), port, &ap7, &hub)).unwrap();
        vec!["-c".into(), file.clone().into()]
    }) else {
        return;
    };
    let port = server.port;
    let names = |station: &str| format!("site = \"harbour\"\nstation = \"{station}\"");
    let hub = start(dir.path(), "fleet", "", port, &hub);
    let own = start(dir.path(), "run", &names("ap7"), port, &ap7);
    let liar = start(dir.path(), "run", &names("ap77"), port, &ap7);
    let of = |v: &Value, name: &str| {
        v["stations"]
            .as_array()
            .is_some_and(|s| s.iter().any(|s| s["station"] == name && s["emitters"] != 0))
    };
    hub.wait_for("/v1/stations", "ap7", |v| of(v, "ap7"));
    let raised = |v: &Value| !alerts(v).is_empty();
    hub.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert of ap7", raised);
    liar.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert at the liar", raised);

    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let said = |station| runtime.block_on(objection(port, &ap7, station));
    assert_eq!(said("ap7"), None);
    let refused = said("ap8").expect("the server refuses another's subject");
    assert!(
        refused.to_lowercase().contains("permissions violation") && refused.contains("ap8"),
        "{refused}"
    );

    let stations: Value = serde_json::from_str(&hub.get("/v1/stations").1).unwrap();
    assert_eq!(stations["stations"].as_array().map(Vec::len), Some(1), "{stations}");
    for alert in alerts(&serde_json::from_str(&hub.get("/v1/alerts?limit=500").1).unwrap()) {
        assert_eq!(alert["station"], "ap7", "{alert}");
    }
    drop(own);
    liar.signal("-TERM");
    let (code, log) = liar.end();
    assert_eq!(code, Some(0));
    assert!(
        log.iter()
            .any(|line| line.contains("WARN") && line.to_lowercase().contains("permissions violation")),
        "{log:?}"
    );
}
