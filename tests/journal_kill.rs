//! kill -9 while the journal is written and webhooks go out: nothing that was confirmed is lost, nothing appears
//! that was never recorded, and every event reaches the receiver in its alert's order.
//!
//! The test starts itself again as the process that is killed (`OAPWATCH_KILL_DIR` tells it so).

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use jiff::Timestamp;
use oapwatch::journal::{self, Journal};
use oapwatch::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};
use oapwatch::notify::{self, Clock, Endpoint};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How often the process is killed.
const KILLS: u64 = 200;

/// Where a request has been seen: message id, alert, type.
type Seen = Arc<Mutex<Vec<(String, String, String)>>>;

fn event(kind: AlertEventKind, id: &str) -> AlertEvent {
    let state = match kind {
        AlertEventKind::Cleared => AlertState::Cleared,
        _ => AlertState::Open,
    };
    let time = Timestamp::UNIX_EPOCH;
    let alert = Alert {
        id: id.to_owned(),
        kind: AlertKind::UnclaimedEmitter,
        severity: Severity::Critical,
        state,
        raised_at: time,
        cleared_at: (state == AlertState::Cleared).then_some(time),
        user: None,
        x_m: Some(1.0),
        y_m: Some(2.0),
        z_m: Some(0.0),
        geodetic: None,
        cov_m2: None,
        claimed: None,
        evidence: serde_json::json!({"text": "x".repeat(300)}),
        source: AlertSource {
            kind: "simulator".to_owned(),
            frame: 1,
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    };
    AlertEvent::new(kind, alert)
}

fn journal_in(dir: &Path) -> journal::Config {
    journal::Config {
        path: Some(dir.join("a.db")),
        ..journal::Config::default()
    }
}

fn webhook_in(dir: &Path) -> Vec<Endpoint> {
    let config = notify::Config {
        name: Some("receiver".to_owned()),
        url: std::fs::read_to_string(dir.join("url")).unwrap(),
        secret_file: dir.join("secret"),
        kinds: None,
        allow_http: false,
        ca_file: None,
        cool_down_s: 0.0,
        timeout_s: 20.0,
    };
    notify::load(&[config]).unwrap()
}

/// The process that is killed: records alerts' lives without end, and says on stdout what it meant to record and
/// what it heard back from the journal.
#[test]
fn child() {
    let Ok(dir) = std::env::var("OAPWATCH_KILL_DIR") else {
        return;
    };
    let dir = Path::new(&dir);
    let round = std::env::var("OAPWATCH_KILL_ROUND").unwrap();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let endpoints = webhook_in(dir);
        let subscriptions = endpoints.iter().map(Endpoint::subscription).collect();
        let journal = Journal::open(&journal_in(dir), subscriptions).unwrap();
        let (_notifier, _task) = notify::spawn(endpoints, journal.clone(), Clock::wall(), 1, std::future::pending());
        let mut follower = journal.follow(journal.last_seq());
        let heard = tokio::spawn(async move {
            loop {
                for recorded in follower.next().await.unwrap() {
                    say(&format!("heard {} {}", recorded.seq, word(&recorded.event)));
                }
            }
        });
        for k in 0.. {
            let id = format!("r{round}-{k}");
            let mut life = vec![event(AlertEventKind::Raised, &id)];
            if k % 3 > 0 {
                life.push(event(AlertEventKind::Updated, &id));
                life.push(event(AlertEventKind::Cleared, &id));
            }
            for event in &life {
                say(&format!("meant 0 {}", word(event)));
            }
            let now = Timestamp::now();
            let seq = journal.record(&life, now, now).unwrap();
            assert!(!heard.is_finished());
            // A few alerts are under way at a time.
            while journal.last_seq() + 12 < seq {
                tokio::task::yield_now().await;
            }
        }
    });
}

fn word(event: &AlertEvent) -> String {
    let kind = serde_json::to_value(event.event).unwrap();
    format!("{} {}", event.alert.id, kind.as_str().unwrap())
}

/// A whole line at once, so that a kill cannot mix two; the harness' own output stands on other lines.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    out.write_all(format!("@{line}\n").as_bytes()).unwrap();
    out.flush().unwrap();
}

async fn receive(State(seen): State<Seen>, headers: HeaderMap, body: Bytes) -> StatusCode {
    let json: serde_json::Value = serde_json::from_slice(&body).unwrap();
    let text = |value: &serde_json::Value| value.as_str().unwrap().to_owned();
    let id = headers["webhook-id"].to_str().unwrap().to_owned();
    seen.lock()
        .unwrap()
        .push((id, text(&json["data"]["id"]), text(&json["type"])));
    StatusCode::NO_CONTENT
}

#[test]
fn two_hundred_kills_lose_nothing_and_invent_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let seen: Seen = Arc::default();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
    std::fs::write(dir.join("url"), format!("http://{}/", listener.local_addr().unwrap())).unwrap();
    std::fs::write(dir.join("secret"), "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
    let app = Router::new().fallback(receive).with_state(seen.clone());
    runtime.spawn(async move { axum::serve(listener, app).await.unwrap() });

    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut meant: BTreeSet<String> = BTreeSet::new();
    let mut heard: BTreeMap<u64, String> = BTreeMap::new();
    for round in 0..KILLS {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["child", "--exact", "--nocapture"])
            .env("OAPWATCH_KILL_DIR", dir)
            .env("OAPWATCH_KILL_ROUND", round.to_string())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        // Counted from its first word, so that the kill falls into the writing, not into the start; every tenth
        // process is killed during its start.
        let (ready, first) = std::sync::mpsc::channel();
        let reader = std::thread::spawn(move || {
            let mut lines = Vec::new();
            for line in out.split(b'\n') {
                let Ok(Ok(line)) = line.map(String::from_utf8) else {
                    break;
                };
                if let Some(said) = line.strip_prefix('@') {
                    lines.push(said.to_owned());
                    let _ = ready.send(());
                }
            }
            lines
        });
        let after_us = match round % 10 {
            0 => rng.random_range(0..30_000),
            _ => {
                first
                    .recv_timeout(Duration::from_secs(20))
                    .expect("the child never began");
                rng.random_range(0..60_000)
            }
        };
        std::thread::sleep(Duration::from_micros(after_us));
        child.kill().unwrap();
        child.wait().unwrap();
        for line in reader.join().unwrap() {
            let mut parts = line.splitn(3, ' ');
            let (what, seq, event) = (parts.next().unwrap(), parts.next().unwrap(), parts.next().unwrap());
            match what {
                "meant" => assert!(meant.insert(event.to_owned())),
                _ => assert_eq!(heard.insert(seq.parse().unwrap(), event.to_owned()), None),
            }
        }
    }
    assert!(
        heard.len() as u64 > KILLS,
        "{} events in {KILLS} lives are no test",
        heard.len()
    );

    // What the journal holds: at least what was heard of, at most what was meant, each transaction whole.
    let endpoints = webhook_in(dir);
    let subscriptions = endpoints.iter().map(Endpoint::subscription).collect();
    let journal = Journal::open(&journal_in(dir), subscriptions).unwrap();
    let integrity: String = rusqlite::Connection::open(dir.join("a.db"))
        .unwrap()
        .query_row("PRAGMA integrity_check", [], |row| row.get(0))
        .unwrap();
    assert_eq!(integrity, "ok");
    let stored: BTreeMap<u64, String> = journal
        .events_after(0, usize::MAX >> 1)
        .unwrap()
        .iter()
        .map(|e| (e.seq, word(&e.event)))
        .collect();
    for (seq, event) in &heard {
        assert_eq!(stored.get(seq), Some(event), "heard of, then lost");
    }
    assert!(
        stored.values().all(|event| meant.contains(event)),
        "recorded, but never meant"
    );
    assert_eq!(
        stored.keys().copied().collect::<Vec<_>>(),
        (1..=stored.len() as u64).collect::<Vec<_>>()
    );
    let open: BTreeSet<String> = journal.open_alerts().unwrap().into_iter().map(|a| a.id).collect();
    let mut expected = BTreeSet::new();
    for event in stored.values() {
        let (id, kind) = event.split_once(' ').unwrap();
        match kind {
            "alert.cleared" => expected.remove(id),
            _ => expected.insert(id.to_owned()),
        };
    }
    assert_eq!(open, expected);

    // A last life delivers what is left.
    let waiting = journal.waiting("receiver", 0).unwrap().len();
    let (notifier, _task) =
        runtime.block_on(async { notify::spawn(endpoints, journal.clone(), Clock::wall(), 1, std::future::pending()) });
    let started = Instant::now();
    while notifier.status()[0].sent < stored.len() as u64 {
        assert!(
            started.elapsed() < Duration::from_secs(20),
            "deliveries never complete: {:?}",
            notifier.status()
        );
        std::thread::sleep(Duration::from_millis(10));
    }
    let seen = seen.lock().unwrap();
    let mut first_seen: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut ids = BTreeSet::new();
    for (id, alert, kind) in seen.iter() {
        if ids.insert(id.clone()) {
            first_seen
                .entry(alert.clone())
                .or_default()
                .push(format!("{alert} {kind}"));
        }
    }
    assert_eq!(ids.len(), stored.len(), "every event was delivered, under one id");
    let mut in_order: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for event in stored.values() {
        let alert = event.split_once(' ').unwrap().0.to_owned();
        in_order.entry(alert).or_default().push(event.clone());
    }
    assert_eq!(first_seen, in_order);
    println!(
        "{KILLS} kills: {} events recorded, {} of them heard, {} deliveries, {} repeated, {waiting} after the last kill",
        stored.len(),
        heard.len(),
        seen.len(),
        seen.len() - ids.len()
    );
}
