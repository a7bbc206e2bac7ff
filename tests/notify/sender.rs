//! The half of the daemon that sends, and alert events for it.

use std::path::Path;
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use jiff::Timestamp;
use oapwatch::journal::{self, Journal};
use oapwatch::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};
use oapwatch::notify::{self, Clock, Endpoint, EndpointStatus, Notifier};
use tokio::sync::oneshot;

pub const KEY: &[u8] = b"a key of at least twenty-four bytes";

pub fn start() -> Timestamp {
    "2026-11-21T08:00:00Z".parse().unwrap()
}

pub fn event(event: AlertEventKind, id: &str, kind: AlertKind) -> AlertEvent {
    let state = match event {
        AlertEventKind::Cleared => AlertState::Cleared,
        AlertEventKind::Acknowledged => AlertState::Acknowledged,
        _ => AlertState::Open,
    };
    let alert = Alert {
        id: id.to_owned(),
        kind,
        severity: Severity::Critical,
        state,
        raised_at: start(),
        cleared_at: None,
        user: None,
        x_m: Some(1.5),
        y_m: Some(-2.5),
        z_m: Some(0.0),
        geodetic: None,
        cov_m2: None,
        claimed: None,
        evidence: serde_json::json!({"log_likelihood_ratio": 12.5}),
        source: AlertSource {
            kind: "replay".to_owned(),
            frame: 7,
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    };
    AlertEvent::new(event, alert)
}

pub fn life(id: &str) -> [AlertEvent; 3] {
    use AlertEventKind::*;
    [Raised, Updated, Cleared].map(|kind| event(kind, id, AlertKind::UnclaimedEmitter))
}

pub struct Daemon {
    pub journal: Journal,
    pub notifier: Notifier,
    stop: Option<oneshot::Sender<()>>,
    task: tokio::task::JoinHandle<()>,
}

impl Daemon {
    pub fn start(journal: &journal::Config, webhooks: &[notify::Config], clock: Clock) -> Self {
        Self::sending_to(journal, notify::load(webhooks).unwrap(), clock)
    }

    pub fn sending_to(journal: &journal::Config, endpoints: Vec<Endpoint>, clock: Clock) -> Self {
        let journal = Journal::open(journal, endpoints.iter().map(Endpoint::subscription).collect()).unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (notifier, task) = notify::spawn(endpoints, journal.clone(), clock, 42, async {
            let _ = stopped.await;
        });
        Self {
            journal,
            notifier,
            stop: Some(stop),
            task,
        }
    }

    pub fn record(&self, events: &[AlertEvent]) {
        self.journal.record(events, start(), start()).unwrap();
    }

    pub fn status(&self) -> EndpointStatus {
        self.notifier.status().remove(0)
    }

    pub async fn stop(mut self) {
        let _ = self.stop.take().unwrap().send(());
        self.task.await.unwrap();
    }
}

/// Waits for a condition that must come true; the bound only keeps a failing test from hanging.
pub async fn until(mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(started.elapsed() < Duration::from_secs(20), "waited in vain");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

pub fn webhook(dir: &Path, url: &str) -> notify::Config {
    let secret_file = dir.join("secret");
    std::fs::write(&secret_file, format!("whsec_{}\n", BASE64_STANDARD.encode(KEY))).unwrap();
    notify::Config {
        name: None,
        url: url.to_owned(),
        secret_file,
        kinds: None,
        allow_http: false,
        ca_file: None,
        cool_down_s: 0.0,
        timeout_s: 20.0,
    }
}

pub fn on_disk(dir: &Path) -> journal::Config {
    journal::Config {
        path: Some(dir.join("a.db")),
        ..journal::Config::default()
    }
}
