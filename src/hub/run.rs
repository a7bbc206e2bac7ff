//! The hub's loop: gives the chain what stations publish and the time, and publishes alerts and positions of all.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use async_nats::{Client, Message};
use jiff::Timestamp;
use serde::de::DeserializeOwned;
use tokio::sync::{mpsc, oneshot, watch};

use super::chain::{Chain, Heard, Settings, Taken};
use super::intake;
use super::latest::Latest;
use super::record::Recorder;
use super::refusals::Refusals;
use super::snapshot;
use super::stations::Refused;
use super::stream::{BATCH, Delivered, consume};
use crate::api::{Acknowledged, Command, Feed, ZonesRefused};
use crate::config::Config;
use crate::fleet::Topic;
use crate::fleet::message::{FromStation, HealthMessage, PositionsMessage};
use crate::journal::Journal;
use crate::monitor::zones::ZoneMap;
use crate::monitor::{Acknowledgement, LightError, MaintenanceError, StationName, Withdrawal};
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
    refusals: Refusals,
    /// At reading the stream of alerts; grows when it is to be read again from the last event that is confirmed.
    attempt: watch::Sender<u64>,
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
            refusals: Refusals::default(),
            attempt: watch::Sender::new(0),
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
        let attempts = self.attempt.subscribe();
        let consumer = tokio::spawn(consume(client.clone(), self.site.clone(), sender, attempts));
        let latest = Arc::new(Latest::default());
        let hearing = tokio::spawn({
            let (latest, site) = (latest.clone(), self.site.clone());
            async move { latest.hear(&client, site.as_deref()).await }
        });
        let mut tick = tokio::time::interval(TICK);
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
                _ = tick.tick() => {
                    let began = Instant::now();
                    self.tick().await;
                    // Messages get half of the time at least, however many stations a picture has to show.
                    let took = began.elapsed();
                    tick.reset_after(TICK.saturating_sub(took).max(took));
                }
                (topic, message) = latest.next() => self.take_latest(topic, &message),
            }
        }
        self.supervisor.stopping();
        consumer.abort();
        hearing.abort();
        self.journal.settled().await;
    }

    /// Gives the chain what was heard, and the recording first.
    fn take(&mut self, heard: Heard, now: Timestamp) -> Vec<Taken> {
        if let Some(recorder) = &mut self.recorder {
            recorder.heard(now, &heard, &self.chain);
        }
        let said = heard.said();
        let outcome = self.chain.take(heard, now);
        if let Some(((topic, name), refused)) = said.zip(outcome.refused) {
            intake::count(topic, refused.name());
            // A repeated event has been taken before: nothing is amiss.
            if refused != Refused::Repeated {
                self.refuse(Some(name), topic, refused.name());
            }
        }
        outcome.taken
    }

    /// Takes a message that raises nothing by itself.
    fn take_latest(&mut self, topic: Topic, message: &Message) {
        let heard = match topic {
            Topic::Health => self.read::<HealthMessage>(message, topic).map(Heard::Health),
            Topic::Pose => self.read(message, topic).map(Box::new).map(Heard::Pose),
            Topic::Positions => self.read::<PositionsMessage>(message, topic).map(Heard::Positions),
            Topic::Alert => self.read(message, topic).map(Box::new).map(Heard::Alert),
        };
        if let Some(heard) = heard {
            self.take(heard, Timestamp::now());
        }
    }

    /// `None` where it cannot be used, which its station's status then shows.
    fn read<T: DeserializeOwned + FromStation>(&mut self, message: &Message, topic: Topic) -> Option<T> {
        let read = intake::read(message, topic);
        if let Err(reason) = read {
            self.refuse(intake::sender(message), topic, reason);
        }
        read.ok()
    }

    fn refuse(&mut self, sender: Option<StationName>, topic: Topic, reason: &'static str) {
        let Some(name) = sender else { return };
        let n = self.refusals.note(&name, reason, Timestamp::now());
        // A station of another version says so ten times a second.
        if n == 1 {
            tracing::warn!(%name, topic = topic.name(), reason, "fleet messages are refused");
        }
    }

    async fn take_alerts(&mut self, mut messages: Vec<Delivered>) {
        let now = Timestamp::now();
        // What an attempt that failed had left behind it comes again, in its order.
        messages.retain(|delivered| delivered.attempt == *self.attempt.borrow());
        let mut taken = Vec::new();
        for Delivered { message, .. } in &messages {
            if let Some(read) = self.read(message, Topic::Alert) {
                taken.extend(self.take(Heard::Alert(Box::new(read)), now));
            }
        }
        if !self.record(taken).await {
            // They are not confirmed, so they come again; what is on disk says from where.
            self.chain.take_again_from(self.journal.origins().unwrap_or_default());
            self.attempt.send_modify(|attempt| *attempt += 1);
            if let Some(recorder) = &mut self.recorder {
                recorder.interrupt();
            }
            return;
        }
        for Delivered { message, .. } in messages {
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
            refusals: &self.refusals,
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
