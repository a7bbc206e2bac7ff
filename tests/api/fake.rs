//! A daemon without frames: what the API needs from one, under the test's control.

use std::collections::{BTreeMap, HashMap};
use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

use jiff::Timestamp;
use ndarray::Array2;
use oapwatch::api::{self, Acknowledged, AlertQuery, AlertStore, Command, Config, Event, Feed, Server, State, StoreError};
use oapwatch::claim::Claim;
use oapwatch::frame::Frame;
use oapwatch::monitor::{
    Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, PositionStatus, Report, Severity,
    TrackedPosition,
};
use oapwatch::optics;
use tokio::sync::{mpsc, oneshot};

/// Keeps alerts and events in memory.
#[derive(Default)]
pub struct Memory {
    pub alerts: Mutex<HashMap<String, Alert>>,
    pub events: Mutex<Vec<Event>>,
}

impl AlertStore for Memory {
    fn list(&self, query: &AlertQuery) -> Result<Vec<Alert>, StoreError> {
        let mut found: Vec<Alert> = self.alerts.lock().unwrap().values().cloned().collect();
        found.sort_by(|a, b| (b.raised_at, &b.id).cmp(&(a.raised_at, &a.id)));
        found.retain(|a| {
            query.state.is_none_or(|s| a.state == s)
                && query.kind.is_none_or(|k| a.kind == k)
                && query.since.is_none_or(|t| a.raised_at >= t)
                && query.before.as_ref().is_none_or(|(t, id)| (a.raised_at, &a.id) < (*t, id))
        });
        found.truncate(query.limit);
        Ok(found)
    }

    fn get(&self, id: &str) -> Result<Option<Alert>, StoreError> {
        Ok(self.alerts.lock().unwrap().get(id).cloned())
    }

    fn events(&self, after: u64, until: u64, limit: usize) -> Result<Vec<Event>, StoreError> {
        let events = self.events.lock().unwrap();
        let between = events.iter().filter(|e| e.seq > after && e.seq <= until);
        Ok(between.take(limit).cloned().collect())
    }
}

/// A running API and the strings that move it.
pub struct Fake {
    pub address: SocketAddr,
    pub feed: Arc<Feed>,
    pub store: Arc<Memory>,
    pub ready: Arc<AtomicBool>,
    stop: Option<oneshot::Sender<()>>,
    served: tokio::task::JoinHandle<Result<(), api::Error>>,
}

pub fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_763_712_000 + second).unwrap()
}

impl Fake {
    pub async fn start(config: Config) -> Self {
        Self::resume(config, Arc::new(Memory::default()), 1).await
    }

    /// Starts on the journal of an earlier run; `now_us` stands for the clock.
    pub async fn resume(config: Config, store: Arc<Memory>, now_us: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let last = store.events.lock().unwrap().last().map_or(0, |e| e.seq);
        let feed = Arc::new(Feed::new(last, now_us));
        let ready = Arc::new(AtomicBool::new(true));
        let (commands, received) = mpsc::channel(64);
        let metrics = oapwatch::metric::recorder().unwrap().handle();
        let state = State::new(feed.clone(), commands, store.clone(), metrics, ready.clone());
        tokio::spawn(answer(received, feed.clone(), store.clone()));
        let (stop, stopped) = oneshot::channel::<()>();
        let server = Server::new(config).unwrap();
        let served = tokio::spawn(server.serve(listener, state, async {
            let _ = stopped.await;
        }));
        Self {
            address,
            feed,
            store,
            ready,
            stop: Some(stop),
            served,
        }
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    pub async fn stop(mut self) {
        self.stop.take();
        self.served.await.unwrap().unwrap();
    }

    /// Publishes frame `number` with the users u-1 (verified) and u-2 (mismatch) and an unclaimed beam.
    pub fn step(&self, number: u64) {
        self.feed.publish(snapshot(number));
    }

    pub fn alert(&self, id: &str, second: i64) {
        publish(&self.feed, &self.store, AlertEventKind::Raised, alert(id, second));
    }
}

fn publish(feed: &Feed, store: &Memory, event: AlertEventKind, alert: Alert) {
    store.alerts.lock().unwrap().insert(alert.id.clone(), alert.clone());
    let events = feed.number(vec![AlertEvent { event, alert }]);
    store.events.lock().unwrap().extend(events.iter().cloned());
    feed.publish_events(events);
}

async fn answer(mut received: mpsc::Receiver<Command>, feed: Arc<Feed>, store: Arc<Memory>) {
    while let Some(command) = received.recv().await {
        match command {
            Command::Claims { claims, reply } => {
                let beyond = |(k, c): (usize, &Claim)| {
                    (c.x_m.abs() > 1e4).then(|| (k, format!("x_m: expected a place near the UAV, found {}", c.x_m)))
                };
                let _ = reply.send(claims.iter().enumerate().filter_map(beyond).collect());
            }
            Command::Acknowledge { id, reply } => {
                let found = store.alerts.lock().unwrap().get(&id).cloned();
                let outcome = match found {
                    None => Acknowledged::Unknown,
                    Some(alert) if alert.state == AlertState::Cleared => Acknowledged::AlreadyCleared,
                    Some(mut alert) => {
                        alert.state = AlertState::Acknowledged;
                        publish(&feed, &store, AlertEventKind::Acknowledged, alert.clone());
                        Acknowledged::Done(Box::new(alert))
                    }
                };
                let _ = reply.send(outcome);
            }
        }
    }
}

pub fn alert(id: &str, second: i64) -> Alert {
    Alert {
        id: id.into(),
        kind: AlertKind::UnclaimedEmitter,
        severity: Severity::Critical,
        state: AlertState::Open,
        raised_at: at(second),
        cleared_at: None,
        user: None,
        x_m: Some(-40.0),
        y_m: Some(60.0),
        cov_m2: Some([[0.01, 0.0], [0.0, 0.01]]),
        claimed: None,
        evidence: serde_json::json!({"seconds_seen": 1.0, "log_likelihood_ratio": 38.2}),
        source: AlertSource {
            kind: "simulator".into(),
            frame: 10,
            file: None,
        },
    }
}

fn beam(track: u64, x_m: f64, y_m: f64, user: Option<&str>, status: PositionStatus) -> TrackedPosition {
    TrackedPosition {
        track,
        x_m,
        y_m,
        cov_m2: [[0.04, 0.01], [0.01, 0.03]],
        energy_j: 0.008,
        user: user.map(str::to_owned),
        status,
        flags: Vec::new(),
    }
}

fn claim(user: &str, x_m: f64, y_m: f64) -> Claim {
    serde_json::from_value(serde_json::json!({"time": at(0), "user": user, "x_m": x_m, "y_m": y_m})).unwrap()
}

pub fn snapshot(number: u64) -> api::Snapshot {
    let camera = Arc::new(optics::Config::default().camera().unwrap());
    let time = at(number as i64);
    let frame = Frame {
        index: number,
        time,
        pixels: Array2::from_shape_fn(camera.shape(), |(y, x)| ((x * y) % 97) as f64 * 1e-6),
        masked: None,
    };
    let report = Report {
        time,
        frame: number,
        emitters: vec![
            beam(1, 10.0, 20.0, Some("u-1"), PositionStatus::Verified),
            beam(2, 55.0, -30.0, Some("u-2"), PositionStatus::Mismatch),
            beam(3, -40.0, 60.0, None, PositionStatus::Unclaimed),
        ],
        unseen: vec!["u-9".into()],
        events: Vec::new(),
        claims: vec![claim("u-1", 10.0, 20.0), claim("u-2", 90.0, -30.0), claim("u-9", 0.0, -90.0)],
    };
    api::Snapshot {
        report,
        frame: Some(Arc::new(frame)),
        status: api::Status {
            version: "0",
            started_at: at(0),
            source: api::SourceStatus {
                kind: "simulator".into(),
                state: api::SourceState::Running,
                rate_hz: 10.0,
                last_good_frame_at: Some(time),
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
            estimator: "fit".into(),
            alerts_open: BTreeMap::new(),
            field_of_view_m: [125.0, 125.0],
        },
        camera,
    }
}
