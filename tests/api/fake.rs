//! A daemon without frames: what the API needs from one, under the test's control.

use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use jiff::Timestamp;
use oapwatch::api::{self, Acknowledged, Command, Config, Feed, Listen, Listener, Server, State, ZonesRefused};
use oapwatch::claim::Claim;
use oapwatch::journal::{self, AuditRecord, Journal};
use oapwatch::monitor::{
    Acknowledgement, Alert, AlertEvent, AlertEventKind, AlertState, Monitor, Source, Window, Withdrawal,
};
use reqwest::{Client, Response, header};
use serde_json::Value;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use super::fixtures::{alert, snapshot};

pub const PATIENCE: Duration = Duration::from_secs(20);

/// A running API and the strings that move it.
pub struct Fake {
    pub address: SocketAddr,
    pub feed: Arc<Feed>,
    pub journal: Journal,
    pub ready: Arc<AtomicBool>,
    stop: Option<oneshot::Sender<()>>,
    served: tokio::task::JoinHandle<Result<(), api::Error>>,
}

pub fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_763_712_000 + second).unwrap()
}

impl Fake {
    pub async fn start(config: Config) -> Self {
        Self::with(config, |state| state).await
    }

    /// Starts with what `complete` adds to its state.
    pub async fn with(config: Config, complete: impl FnOnce(State) -> State) -> Self {
        let journal = Journal::open(&journal::Config::default(), Vec::new()).unwrap();
        Self::on_port(config, journal, 1, complete).await
    }

    /// Starts on the journal of an earlier run; `now_us` stands for the clock.
    pub async fn resume(config: Config, journal: Journal, now_us: u64) -> Self {
        Self::on_port(config, journal, now_us, |state| state).await
    }

    /// Starts on a Unix socket; `address` is then of no use.
    pub async fn on_socket(config: Config, socket: &Path) -> Self {
        let journal = Journal::open(&journal::Config::default(), Vec::new()).unwrap();
        let listener = Listener::bind(&Listen::Unix(socket.to_owned())).unwrap();
        let at = (listener, SocketAddr::from(([127, 0, 0, 1], 0)));
        Self::serve(config, journal, 1, at, |state| state).await
    }

    /// Starts with the folder of a recorder.
    pub async fn with_recordings(config: Config, folder: &Path) -> Self {
        Self::with(config, |state| state.with_evidence(folder, &Default::default())).await
    }

    async fn on_port(config: Config, journal: Journal, now_us: u64, complete: impl FnOnce(State) -> State) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        Self::serve(config, journal, now_us, (listener.into(), address), complete).await
    }

    async fn serve(
        config: Config,
        journal: Journal,
        now_us: u64,
        (listener, address): (Listener, SocketAddr),
        complete: impl FnOnce(State) -> State,
    ) -> Self {
        // reqwest is built without a default; a second installation finds the first in place.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let feed = Arc::new(Feed::new(journal.last_seq(), now_us));
        let ready = Arc::new(AtomicBool::new(true));
        let (commands, received) = mpsc::channel(64);
        let metrics = oapwatch::metric::recorder().unwrap().handle();
        let state = State::new(feed.clone(), commands, journal.clone(), metrics, ready.clone());
        let state = complete(state);
        tokio::spawn(answer(received, feed.clone(), journal.clone()));
        let (stop, stopped) = oneshot::channel::<()>();
        let server = Server::new(config).unwrap();
        let served = tokio::spawn(server.serve(listener, state, async {
            let _ = stopped.await;
        }));
        Self {
            address,
            feed,
            journal,
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

    /// Raises without waiting for the journal.
    pub fn raise_at_once(&self, id: &str) {
        let event = AlertEvent::new(AlertEventKind::Raised, alert(id, 0));
        let events = self.feed.number(vec![event], at(0));
        self.journal.record_numbered(&events, at(0)).unwrap();
        self.feed.publish_events(events);
    }

    pub async fn alert(&self, id: &str, second: i64) {
        publish(&self.feed, &self.journal, AlertEventKind::Raised, alert(id, second)).await;
    }
}

pub async fn get(fake: &Fake, path: &str) -> Response {
    Client::new().get(fake.url(path)).send().await.unwrap()
}

pub async fn json_of(response: Response) -> Value {
    serde_json::from_slice(&response.bytes().await.unwrap()).unwrap()
}

/// Asserts problem details of this status and gives their detail.
pub async fn problem(response: Response, status: u16) -> String {
    assert_eq!(response.status().as_u16(), status);
    assert_eq!(response.headers()[header::CONTENT_TYPE], "application/problem+json");
    let body = json_of(response).await;
    assert_eq!(body["status"], status);
    assert_eq!(body["type"], "about:blank");
    body["detail"].as_str().unwrap().to_owned()
}

/// Rows of the audit log about one action, newest first.
pub async fn audited(fake: &Fake, action: &str) -> Vec<AuditRecord> {
    fake.journal.settled().await;
    let rows = fake.journal.audit_log(None, 100).unwrap();
    let of = |r: &AuditRecord| serde_json::to_value(r.entry.action).unwrap() == action;
    rows.into_iter().filter(of).collect()
}

/// Reads until the server closes; gives what it said.
pub async fn until_closed(mut stream: TcpStream) -> String {
    let mut said = Vec::new();
    // A reset is a close too.
    let _ = timeout(PATIENCE, stream.read_to_end(&mut said))
        .await
        .expect("the server closes");
    String::from_utf8_lossy(&said).into_owned()
}

pub async fn publish(feed: &Feed, journal: &Journal, event: AlertEventKind, alert: Alert) {
    let events = feed.number(vec![AlertEvent::new(event, alert)], at(0));
    journal.record_numbered(&events, at(0)).unwrap();
    journal.settled().await;
    feed.publish_events(events);
}

async fn answer(mut received: mpsc::Receiver<Command>, feed: Arc<Feed>, journal: Journal) {
    let source = Source {
        kind: "replay".into(),
        file: None,
        rate_hz: 10.0,
    };
    let camera = oapwatch::optics::Config::default().camera().unwrap();
    let mut monitor = Monitor::new(&Default::default(), &Default::default(), &camera, source);
    while let Some(command) = received.recv().await {
        match command {
            Command::Claims { claims, reply } => {
                let beyond = |(k, c): (usize, &Claim)| {
                    (c.x_m.abs() > 1e4).then(|| (k, format!("x_m: expected a place near the UAV, found {}", c.x_m)))
                };
                let _ = reply.send(claims.iter().enumerate().filter_map(beyond).collect());
            }
            Command::Acknowledge { id, by, note, reply } => {
                let change = |alert: &mut Alert| {
                    alert.state = AlertState::Acknowledged;
                    alert.acknowledgement = Some(Acknowledgement {
                        at: at(0),
                        by,
                        note,
                        withdrawn: None,
                    });
                    AlertEventKind::Acknowledged
                };
                let _ = reply.send(changed(&feed, &journal, &id, change).await);
            }
            Command::Unacknowledge { id, by, reply } => {
                let change = |alert: &mut Alert| {
                    alert.state = AlertState::Open;
                    if let Some(acknowledgement) = &mut alert.acknowledgement {
                        acknowledgement.withdrawn = Some(Withdrawal { at: at(1), by });
                    }
                    AlertEventKind::Unacknowledged
                };
                let _ = reply.send(changed(&feed, &journal, &id, change).await);
            }
            places => place(&mut monitor, places),
        }
    }
}

/// Zones, known lights and maintenance by a monitor that sees nothing.
fn place(monitor: &mut Monitor, command: Command) {
    match command {
        Command::KnownLights { reply } => drop(reply.send(monitor.known_lights())),
        Command::Approve { mut request, reply } => {
            request.at = at(0);
            drop(reply.send(monitor.approve(request)));
        }
        Command::Revoke { id, reply } => drop(reply.send(monitor.revoke(&id))),
        Command::Zones { reply } => drop(reply.send(monitor.zones())),
        Command::PutZones {
            zones,
            unless_changed,
            reply,
        } => {
            let is_changed = unless_changed.is_some_and(|digest| digest != monitor.zones().digest());
            let put = match is_changed {
                true => Err(ZonesRefused::Changed),
                false => monitor.set_zones(zones).map_err(ZonesRefused::Bad),
            };
            drop(reply.send(put.map(|()| monitor.zones())));
        }
        Command::Maintenance { reply } => drop(reply.send(monitor.maintenance(at(0)))),
        Command::BeginMaintenance {
            from,
            until,
            by,
            note,
            reply,
        } => {
            let window = Window {
                id: "maintenance-1".into(),
                from: from.unwrap_or(at(0)),
                until,
                by,
                note,
                is_fixed: false,
            };
            drop(reply.send(monitor.add_maintenance(window.clone()).map(|()| window)));
        }
        Command::EndMaintenance { id, reply } => drop(reply.send(monitor.end_maintenance(&id))),
        _ => {}
    }
}

async fn changed(
    feed: &Feed,
    journal: &Journal,
    id: &str,
    change: impl FnOnce(&mut Alert) -> AlertEventKind,
) -> Acknowledged {
    match journal.alert(id).unwrap() {
        None => Acknowledged::Unknown,
        Some(alert) if alert.state == AlertState::Cleared => Acknowledged::AlreadyCleared,
        Some(mut alert) => {
            let event = change(&mut alert);
            publish(feed, journal, event, alert.clone()).await;
            Acknowledged::Done(Box::new(alert))
        }
    }
}
