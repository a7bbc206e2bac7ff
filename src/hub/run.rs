//! The hub's loop: gives the chain what stations publish and the time, and publishes alerts and positions of all.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_nats::{Client, Message, jetstream};
use futures_util::StreamExt;
use jiff::Timestamp;
use tokio::sync::{mpsc, oneshot};
use tokio::time::MissedTickBehavior;

use super::chain::{Chain, Heard, Settings, Taken};
use super::intake;
use super::record::Recorder;
use super::snapshot;
use super::stream::{BATCH, consume, subscribe};
use crate::api::{Acknowledged, Command, Feed, ZonesRefused};
use crate::config::Config;
use crate::fleet::Topic;
use crate::fleet::message::{HealthMessage, PositionsMessage};
use crate::journal::Journal;
use crate::monitor::zones::ZoneMap;
use crate::monitor::{Acknowledgement, LightError, MaintenanceError, Withdrawal};
use crate::notify::Notifier;
use crate::optics::Camera;
use crate::supervisor::Supervisor;

/// Interval of the pictures and of what is judged over all stations.
const TICK: Duration = Duration::from_millis(100);
/// Longest time that a hanging disk delays the publication of an event.
const JOURNAL_TIMEOUT: Duration = Duration::from_secs(2);

pub struct Run {
    site: Option<String>,
    journal: Journal,
    feed: Arc<Feed>,
    notifier: Notifier,
    ready: Arc<AtomicBool>,
    started_at: Timestamp,
    camera: Arc<Camera>,
    chain: Chain,
    recorder: Option<Recorder>,
    supervisor: Supervisor,
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
        let (open, taken) = (journal.open_alerts()?, journal.origins()?);
        Ok(Self {
            site: config.fleet.site.clone(),
            journal,
            feed,
            notifier,
            ready,
            started_at,
            camera: Arc::new(config.optics.camera()?),
            chain: Chain::new(Settings::new(config), open, taken, started_at),
            recorder: Recorder::start(&config.record)?,
            supervisor: Supervisor::default(),
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
        let (mut positions, mut poses, mut health) = (
            subscribe(Topic::Positions).await,
            subscribe(Topic::Pose).await,
            subscribe(Topic::Health).await,
        );
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
                Some(message) = health.next() => self.take_message::<HealthMessage>(&message, Topic::Health, Heard::Health),
                Some(message) = poses.next() => self.take_message(&message, Topic::Pose, Heard::Pose),
                Some(message) = positions.next() => {
                    self.take_message::<PositionsMessage>(&message, Topic::Positions, Heard::Positions);
                }
            }
        }
        self.supervisor.stopping();
        consumer.abort();
        self.journal.settled().await;
    }

    /// Gives the chain what was heard, and the recording first.
    fn take(&mut self, heard: Heard, now: Timestamp) -> Vec<Taken> {
        if let Some(recorder) = &mut self.recorder {
            recorder.heard(now, &heard, &self.chain);
        }
        let topic = heard.topic();
        let outcome = self.chain.take(heard, now);
        if let Some((topic, refused)) = topic.zip(outcome.refused) {
            intake::count(topic, refused.name());
        }
        outcome.taken
    }

    /// Takes a message that raises nothing by itself.
    fn take_message<T: serde::de::DeserializeOwned>(
        &mut self,
        message: &Message,
        topic: Topic,
        heard: impl Fn(T) -> Heard,
    ) {
        if let Some(read) = intake::read(message, topic) {
            self.take(heard(read), Timestamp::now());
        }
    }

    async fn take_alerts(&mut self, messages: Vec<jetstream::Message>) {
        let now = Timestamp::now();
        let mut taken = Vec::new();
        for message in &messages {
            if let Some(read) = intake::read(message, Topic::Alert) {
                taken.extend(self.take(Heard::Alert(read), now));
            }
        }
        if !self.record(taken).await {
            // They are not confirmed, so they come again; what is on disk says from where.
            self.chain.take_again_from(self.journal.origins().unwrap_or_default());
            if let Some(recorder) = &mut self.recorder {
                recorder.interrupt();
            }
            return;
        }
        for message in messages {
            if let Err(error) = message.ack().await {
                tracing::debug!(%error, "an alert event is not confirmed; it comes again and is recognised");
            }
        }
    }

    /// Events to the journal, then to readers. Whether the journal took them.
    async fn record(&self, taken: Vec<Taken>) -> bool {
        if taken.is_empty() {
            return true;
        }
        let mut numbered = Vec::with_capacity(taken.len());
        let mut origins = Vec::with_capacity(taken.len());
        for Taken { event, at, origin } in taken {
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
        let taken = self.take(Heard::Tick, now);
        self.record(taken).await;
        let facts = snapshot::Facts {
            started_at: self.started_at,
            rate_hz: 1.0 / TICK.as_secs_f64(),
            camera: self.camera.clone(),
            journal: self.journal.health(),
            webhooks: self.notifier.status(),
        };
        let snapshot = snapshot::of(&mut self.chain, facts, now);
        let stations = snapshot.status.stations.len();
        self.feed.publish(snapshot);
        self.ready.store(true, Ordering::Relaxed);
        self.supervisor.alive(&format!("{stations} access points"));
    }

    async fn obey(&mut self, command: Command) {
        let now = Timestamp::now();
        match command {
            Command::Claims { claims, reply } => {
                let reason = "a hub takes no claims: send them to the access points".to_owned();
                let refused = (0..claims.len()).map(|k| (k, reason.clone())).collect();
                // A client that has gone away needs no answer.
                let _ = reply.send(refused);
            }
            Command::Acknowledge { id, by, note, reply } => {
                let note = Acknowledgement {
                    at: now,
                    by,
                    note,
                    withdrawn: None,
                };
                let heard = Heard::Acknowledge { id: id.clone(), note };
                self.change(id, heard, now, reply).await;
            }
            Command::Unacknowledge { id, by, reply } => {
                let withdrawal = Withdrawal { at: now, by };
                let heard = Heard::Withdraw {
                    id: id.clone(),
                    withdrawal,
                };
                self.change(id, heard, now, reply).await;
            }
            other => refuse_places(other),
        }
    }

    /// What an operator does to one alert.
    async fn change(&mut self, id: String, heard: Heard, now: Timestamp, reply: oneshot::Sender<Acknowledged>) {
        let is_open = self.chain.alert(&id).is_some();
        if is_open {
            let taken = self.take(heard, now);
            self.record(taken).await;
        }
        let answer = match self.chain.alert(&id) {
            Some(alert) => Acknowledged::Done(Box::new(alert.clone())),
            None => {
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
