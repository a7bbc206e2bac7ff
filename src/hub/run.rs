//! The hub's loop: takes what stations publish, and publishes alerts and positions of all.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::{Client, Subscriber, jetstream};
use futures_util::StreamExt;
use jiff::Timestamp;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::alerts::{Finding, HubAlerts, OwnCause};
use super::conflicts::Conflicts;
use super::intake;
use super::stations::Stations;
use crate::api::{
    Acknowledged, ClaimsStatus, Command, Feed, FrameCounts, JournalStatus, Latency, Snapshot, SourceState,
    SourceStatus, Status, ZonesRefused,
};
use crate::config::Config;
use crate::fleet::message::{AlertMessage, HealthMessage, PositionsMessage};
use crate::fleet::{Subject, Topic, ensure_stream};
use crate::journal::{Journal, Origin};
use crate::monitor::zones::ZoneMap;
use crate::monitor::{Acknowledgement, AlertEvent, LightError, MaintenanceError, Report, Withdrawal};
use crate::notify::Notifier;
use crate::optics::Camera;

/// Interval of the pictures and of what is judged over all stations.
const TICK: Duration = Duration::from_millis(100);
/// Alert events taken at once; they are confirmed to the server when all of them are on disk.
const BATCH: usize = 256;
/// The server delivers an event again that is not confirmed within this time.
const ACK_WAIT: Duration = Duration::from_secs(30);
/// Wait before the stream is asked for again.
const RETRY: Duration = Duration::from_secs(1);
/// Longest time that a hanging disk delays the publication of an event.
const JOURNAL_TIMEOUT: Duration = Duration::from_secs(2);
/// Name of the hub's place in the stream.
const CONSUMER: &str = "hub";

/// An event that is to be recorded, with its place in its station's journal.
type Taken = (AlertEvent, Timestamp, Option<Origin>);

pub struct Run {
    site: Option<String>,
    lost_after_s: f64,
    tolerated_m: f64,
    journal: Journal,
    feed: Arc<Feed>,
    notifier: Notifier,
    ready: Arc<AtomicBool>,
    started_at: Timestamp,
    camera: Arc<Camera>,
    alerts: HubAlerts,
    conflicts: Conflicts,
    stations: Stations,
    /// The last event taken from each station's journal.
    taken: BTreeMap<String, u64>,
}

impl Run {
    pub fn new(
        config: &Config,
        journal: Journal,
        feed: Arc<Feed>,
        notifier: Notifier,
        ready: Arc<AtomicBool>,
        started_at: Timestamp,
    ) -> anyhow::Result<Self> {
        let mut alerts = HubAlerts::default();
        alerts.restore(journal.open_alerts()?);
        let mut conflicts = Conflicts::default();
        let mut stations = Stations::default();
        for cause in alerts.own_causes() {
            match cause {
                OwnCause::UserInTwoPlaces(user) => conflicts.restore(std::iter::once(user), started_at),
                // It is lost until it says something.
                OwnCause::StationLost(name) => drop(stations.take_sign(&name, Timestamp::UNIX_EPOCH)),
            }
        }
        Ok(Self {
            site: config.fleet.site.clone(),
            lost_after_s: config.fleet.lost_after_s,
            tolerated_m: config.monitor.tolerated_distance_m,
            taken: journal.origins()?,
            journal,
            feed,
            notifier,
            ready,
            started_at,
            camera: Arc::new(config.optics.camera()?),
            alerts,
            conflicts,
            stations,
        })
    }

    /// Works until `shutdown` completes.
    pub async fn run(
        mut self,
        client: Client,
        mut commands: mpsc::Receiver<Command>,
        shutdown: impl Future<Output = ()> + Send,
    ) {
        let (sender, mut alerts) = mpsc::channel(BATCH);
        let consumer = tokio::spawn(consume(client.clone(), self.site.clone(), sender));
        let subscribe = |topic| subscribe(&client, self.site.as_deref(), topic);
        let (mut positions, mut health) = (subscribe(Topic::Positions).await, subscribe(Topic::Health).await);
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut shutdown = std::pin::pin!(shutdown);
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            tokio::select! {
                biased;
                () = &mut shutdown => break,
                n = alerts.recv_many(&mut batch, BATCH) => {
                    if n == 0 {
                        break;
                    }
                    self.take_alerts(std::mem::take(&mut batch)).await;
                }
                Some(command) = commands.recv() => self.obey(command).await,
                _ = tick.tick() => self.tick().await,
                Some(message) = health.next() => {
                    if let Some(read) = intake::read::<HealthMessage>(&message, Topic::Health)
                        && let Err(refused) = self.stations.take_health(read, Timestamp::now())
                    {
                        intake::count(Topic::Health, refused.name());
                    }
                }
                Some(message) = positions.next() => {
                    if let Some(read) = intake::read::<PositionsMessage>(&message, Topic::Positions)
                        && let Err(refused) = self.stations.take_positions(read, Timestamp::now())
                    {
                        intake::count(Topic::Positions, refused.name());
                    }
                }
            }
        }
        consumer.abort();
        self.journal.settled().await;
    }

    async fn take_alerts(&mut self, messages: Vec<jetstream::Message>) {
        let now = Timestamp::now();
        let mut taken = Vec::new();
        for message in &messages {
            if let Some(read) = intake::read::<AlertMessage>(message, Topic::Alert) {
                taken.extend(self.take_alert(read, now));
            }
        }
        if !self.record(taken).await {
            // They are not confirmed, so they come again; what is on disk says from where.
            self.taken = self.journal.origins().unwrap_or_default();
            return;
        }
        for message in messages {
            if let Err(error) = message.ack().await {
                tracing::debug!(%error, "an alert event is not confirmed; it comes again and is recognised");
            }
        }
    }

    fn take_alert(&mut self, message: AlertMessage, now: Timestamp) -> Option<Taken> {
        let source = format!("{}/{}", message.name, message.journal);
        if self.taken.get(&source).is_some_and(|&last| message.seq <= last) {
            intake::count(Topic::Alert, "repeated");
            return None;
        }
        self.taken.insert(source.clone(), message.seq);
        if let Err(refused) = self.stations.take_sign(&message.name, now) {
            intake::count(Topic::Alert, refused.name());
        }
        let (stations, name) = (&self.stations, &message.name);
        let is_seen_elsewhere = |user: &str| stations.is_seen_elsewhere(user, name, now);
        let event = self.alerts.take(name, message.event, is_seen_elsewhere)?;
        let origin = Origin {
            source: source.into(),
            seq: message.seq,
        };
        Some((event, message.at, Some(origin)))
    }

    /// Events to the journal, then to readers. Whether the journal took them.
    async fn record(&self, taken: Vec<Taken>) -> bool {
        if taken.is_empty() {
            return true;
        }
        let mut numbered = Vec::with_capacity(taken.len());
        let mut origins = Vec::with_capacity(taken.len());
        for (event, at, origin) in taken {
            numbered.extend(self.feed.number(vec![event], at));
            origins.push(origin);
        }
        let recorded = self
            .journal
            .record_from(&numbered, |k| origins[k].clone(), Timestamp::now());
        if let Err(error) = &recorded {
            tracing::error!(%error, "alert events are lost to the journal");
        }
        if tokio::time::timeout(JOURNAL_TIMEOUT, self.journal.settled())
            .await
            .is_err()
        {
            tracing::error!("the journal's disk hangs; alerts are published before they are on it");
        }
        self.feed.publish_events(numbered);
        recorded.is_ok()
    }

    async fn tick(&mut self) {
        let now = Timestamp::now();
        let mut events: Vec<Option<AlertEvent>> = Vec::new();
        let uptime = super::stations::seconds(self.started_at, now);
        for (name, is_lost, last_seen) in self.stations.lost(now, self.lost_after_s) {
            let cause = OwnCause::StationLost(name.clone());
            // Just started, the hub has not had the time to hear of anybody.
            if is_lost && uptime > self.lost_after_s {
                let evidence = json!({ "last_seen_at": last_seen, "lost_after_s": self.lost_after_s });
                let finding = Finding {
                    evidence,
                    ..Finding::default()
                };
                events.push(self.alerts.raise(cause, finding, now));
            } else if !is_lost {
                events.push(self.alerts.clear(&cause, now));
            }
        }
        let found = self.stations.conflicts(now, self.tolerated_m);
        let (standing, over) = self.conflicts.step(found, now);
        for (user, [a, b]) in standing {
            let place = |s: &super::stations::Sighting| {
                json!({ "site": s.name.site, "station": s.name.station, "x_m": s.x_m, "y_m": s.y_m,
                        "by": if s.is_seen { "beam" } else { "claim" } })
            };
            let seen = if a.is_seen { &a } else { &b };
            let finding = Finding {
                place_m: Some([seen.x_m, seen.y_m, seen.z_m]),
                geodetic: seen.geodetic,
                evidence: json!({ "places": [place(&a), place(&b)], "distance_m": (a.x_m - b.x_m).hypot(a.y_m - b.y_m) }),
            };
            events.push(self.alerts.raise(OwnCause::UserInTwoPlaces(user), finding, now));
        }
        for user in over {
            events.push(self.alerts.clear(&OwnCause::UserInTwoPlaces(user), now));
        }
        let taken = events.into_iter().flatten().map(|event| (event, now, None));
        self.record(taken.collect()).await;
        self.publish(now);
    }

    /// The picture of all stations, as one station's would be.
    fn publish(&mut self, now: Timestamp) {
        let picture = self.stations.picture(now, self.tolerated_m);
        let stations = self.stations.statuses(now, self.lost_after_s);
        let health = self.journal.health();
        let furthest = picture
            .emitters
            .iter()
            .fold([1.0f64; 2], |[x, y], e| [x.max(e.x_m.abs()), y.max(e.y_m.abs())]);
        let views = stations.iter().filter_map(|s| s.field_of_view_m);
        let field_of_view_m = views.fold(furthest, |[x, y], [a, b]| [x.max(a), y.max(b)]);
        let is_running = !stations.is_empty();
        let snapshot = Snapshot {
            frame: None,
            camera: self.camera.clone(),
            pose: None,
            status: Status {
                version: env!("CARGO_PKG_VERSION"),
                started_at: self.started_at,
                source: SourceStatus {
                    kind: "fleet".to_owned(),
                    state: if is_running {
                        SourceState::Running
                    } else {
                        SourceState::Starting
                    },
                    rate_hz: 1.0 / TICK.as_secs_f64(),
                    last_good_frame_at: is_running.then_some(picture.time),
                    fault: None,
                },
                frames: FrameCounts::default(),
                latency: Latency::default(),
                claims: ClaimsStatus {
                    users: picture.claims.len() as u64,
                    ..ClaimsStatus::default()
                },
                journal: JournalStatus {
                    healthy: health.writable,
                    place: health
                        .path
                        .as_ref()
                        .map_or("memory".to_owned(), |p| p.display().to_string()),
                    fault: if health.writable { None } else { health.last_error },
                },
                webhooks: self.notifier.status(),
                estimator: "fleet".to_owned(),
                alerts_open: self.alerts.open_by_kind(),
                field_of_view_m,
                view: None,
                stations,
            },
            report: Report {
                time: now,
                frame: picture.frame,
                emitters: picture.emitters,
                unseen: picture.unseen,
                events: Vec::new(),
                claims: picture.claims,
            },
        };
        self.feed.publish(snapshot);
        self.ready.store(true, Ordering::Relaxed);
    }

    async fn obey(&mut self, command: Command) {
        let now = Timestamp::now();
        let withdrawn = None;
        let (outcome, reply) = match command {
            Command::Claims { claims, reply } => {
                let reason = "a hub takes no claims: send them to the access points".to_owned();
                let refused = (0..claims.len()).map(|k| (k, reason.clone())).collect();
                // A client that has gone away needs no answer.
                let _ = reply.send(refused);
                return;
            }
            Command::Acknowledge { id, by, note, reply } => {
                let note = Acknowledgement {
                    at: now,
                    by,
                    note,
                    withdrawn,
                };
                (self.alerts.acknowledge(&id, note).ok_or(id), reply)
            }
            Command::Unacknowledge { id, by, reply } => {
                (self.alerts.withdraw(&id, Withdrawal { at: now, by }).ok_or(id), reply)
            }
            other => return refuse_places(other),
        };
        let answer = match outcome {
            Ok((alert, event)) => {
                self.record(event.map(|event| (event, now, None)).into_iter().collect())
                    .await;
                Acknowledged::Done(Box::new(alert))
            }
            Err(id) => {
                let journal = self.journal.clone();
                let known = tokio::task::spawn_blocking(move || journal.alert(&id)).await;
                match known {
                    Ok(Ok(Some(_))) => Acknowledged::AlreadyCleared,
                    _ => Acknowledged::Unknown,
                }
            }
        };
        let _ = reply.send(answer);
    }
}

/// The link may be down: the subscription stands once it is up.
async fn subscribe(client: &Client, site: Option<&str>, topic: Topic) -> Subscriber {
    loop {
        match client.subscribe(Subject::of_all(site, topic)).await {
            Ok(subscriber) => return subscriber,
            Err(error) => tracing::warn!(%error, "the fleet's messages cannot be subscribed to"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// Reads the stream of alerts from where an earlier run ended, for ever.
async fn consume(client: Client, site: Option<String>, alerts: mpsc::Sender<jetstream::Message>) {
    let context = jetstream::new(client);
    let name = site
        .as_ref()
        .map_or(CONSUMER.to_owned(), |site| format!("{CONSUMER}-{site}"));
    let mut is_told = false;
    loop {
        match stream(&context, &name, site.as_deref(), &alerts).await {
            Ok(()) => return,
            Err(error) if !std::mem::replace(&mut is_told, true) => {
                tracing::warn!(error, "the stream of alerts cannot be read; it is tried again");
            }
            Err(error) => tracing::debug!(error, "the stream of alerts cannot be read"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn stream(
    context: &jetstream::Context,
    name: &str,
    site: Option<&str>,
    alerts: &mpsc::Sender<jetstream::Message>,
) -> Result<(), String> {
    let stream = ensure_stream(context).await.map_err(|e| e.to_string())?;
    let config = pull::Config {
        durable_name: Some(name.to_owned()),
        deliver_policy: DeliverPolicy::All,
        ack_policy: AckPolicy::Explicit,
        ack_wait: ACK_WAIT,
        max_ack_pending: BATCH as i64,
        filter_subject: Subject::of_all(site, Topic::Alert),
        ..pull::Config::default()
    };
    let consumer = stream
        .get_or_create_consumer(name, config)
        .await
        .map_err(|e| e.to_string())?;
    let mut messages = consumer.messages().await.map_err(|e| e.to_string())?;
    while let Some(message) = messages.next().await {
        let message = message.map_err(|e| e.to_string())?;
        if alerts.send(message).await.is_err() {
            return Ok(());
        }
    }
    Err("the server ended it".to_owned())
}

/// Zones, known lights and maintenance are the access points' own.
fn refuse_places(command: Command) {
    match command {
        Command::KnownLights { reply } => drop(reply.send(Vec::new())),
        Command::Approve { reply, .. } | Command::Revoke { reply, .. } => drop(reply.send(Err(LightError::AtHub))),
        Command::Zones { reply } => drop(reply.send(ZoneMap::default())),
        Command::PutZones { reply, .. } => drop(reply.send(Err(ZonesRefused::AtHub))),
        Command::Maintenance { reply } => drop(reply.send(Vec::new())),
        Command::BeginMaintenance { reply, .. } | Command::EndMaintenance { reply, .. } => {
            drop(reply.send(Err(MaintenanceError::AtHub)));
        }
        Command::Claims { .. } | Command::Acknowledge { .. } | Command::Unacknowledge { .. } => {}
    }
}
