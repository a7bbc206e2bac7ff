//! What a station publishes. Nothing of the station waits for the server: alerts wait in the journal, the rest is dropped.

use std::sync::Arc;
use std::time::Duration;

use async_nats::connection::State;
use async_nats::{Client, HeaderMap, header, jetstream};
use jiff::Timestamp;
use metrics::{counter, gauge};
use tokio::time::MissedTickBehavior;

use super::claimed_height::at_claimed_height;
use super::claims::{self, Intake};
use super::config::Config;
use super::connection::{self, Access, Error};
use super::message::{AlertMessage, HealthMessage, PoseMessage, PositionsMessage, VERSION};
use super::subject::{Subject, Topic};
use crate::api::{Feed, Published};
use crate::claim::Claim;
use crate::journal::{Attempt, Journal, Outcome, Subscription, Waiting};
use crate::metric;
use crate::monitor::{StationName, TrackedPosition};
use crate::platform::Kind as PlatformKind;

/// The fleet's name in the journal's outbox.
pub const ENDPOINT: &str = "fleet";
/// Deliveries read from the outbox at once.
const PAGE: usize = 256;
/// Interval of the health messages. The hub misses a station after `lost_after_s`, at least twice this.
const HEALTH: Duration = Duration::from_secs(1);
/// Waits between attempts to publish an alert: the first, and the longest after doubling.
const RETRY: Duration = Duration::from_millis(100);
const SLOWEST_RETRY: Duration = Duration::from_secs(5);

/// A station that can be published for.
pub struct Station {
    name: StationName,
    config: Config,
    access: Access,
}

impl Station {
    /// `None` where nothing is to be published.
    pub fn new(config: &Config) -> Result<Option<Self>, Error> {
        let Some(name) = config.station()? else { return Ok(None) };
        Ok(Some(Self {
            name,
            config: config.clone(),
            access: Access::read(config)?,
        }))
    }

    /// Every event, an operator's acts included: the hub shows an alert as its station does.
    pub fn subscription() -> Subscription {
        Subscription {
            endpoint: ENDPOINT.to_owned(),
            kinds: None,
            has_operator_acts: true,
        }
    }

    /// Publishes, and hears claims where there is an intake, until `shutdown` completes; what is left of the alerts waits in the journal
    /// for the next start.
    pub async fn run(
        self,
        journal: Journal,
        feed: Arc<Feed>,
        intake: Option<Intake>,
        shutdown: impl Future<Output = ()>,
    ) -> Result<(), Error> {
        let client = self.access.connect(self.name.to_string(), connection::CAPACITY).await?;
        tokio::select! {
            () = shutdown => {}
            () = self.alerts(&client, &journal) => {}
            () = self.positions(&client, &feed) => {}
            () = self.health(&client, &journal, &feed) => {}
            heard = self.claims(intake) => heard?,
        }
        Ok(())
    }

    /// Over a connection of its own: however many claims come, nothing else waits behind them.
    async fn claims(&self, intake: Option<Intake>) -> Result<(), Error> {
        if let Some((subject, intake)) = self.config.claims_subject.as_deref().zip(intake) {
            let name = format!("{}.claims", self.name);
            let client = self.access.connect(name, claims::CAPACITY).await?;
            claims::receive(&client, subject, &intake).await;
        }
        std::future::pending().await
    }

    fn subject(&self, topic: Topic) -> String {
        let name = self.name.clone();
        Subject { name, topic }.to_string()
    }

    /// Alerts in the order of the journal, one at a time: the hub takes a gap in their numbers for events that it has.
    async fn alerts(&self, client: &Client, journal: &Journal) {
        let context = jetstream::new(client.clone());
        let mut heard = journal.heard();
        let mut sent_to = 0;
        loop {
            heard.mark_unchanged();
            let rows = {
                let journal = journal.clone();
                let read = move || journal.first_waiting(ENDPOINT, sent_to, PAGE);
                tokio::task::spawn_blocking(read).await
            };
            let rows = match rows {
                Ok(Ok(rows)) => rows,
                Ok(Err(error)) => {
                    tracing::warn!(%error, "the fleet's outbox cannot be read");
                    tokio::time::sleep(SLOWEST_RETRY).await;
                    continue;
                }
                Err(_) => return,
            };
            if rows.is_empty() {
                // An error would mean that the sender, which the journal holds, is gone.
                let _ = heard.changed().await;
                continue;
            }
            for row in rows {
                sent_to = row.seq;
                self.deliver(&context, journal, row).await;
            }
        }
    }

    /// Publishes one event until the server has stored it.
    async fn deliver(&self, context: &jetstream::Context, journal: &Journal, row: Waiting) {
        let mut retry = RETRY;
        loop {
            let error = match self.publish(context, journal, row.seq).await {
                Ok(()) => break,
                Err(error) => error,
            };
            counter!(metric::FLEET_ALERTS, "outcome" => "failed").increment(1);
            if retry == RETRY {
                tracing::warn!(seq = row.seq, %error, "an alert event waits for the NATS server");
            }
            if context.client().connection_state() == State::Connected
                && let Err(error) = connection::ensure_stream(context).await
            {
                tracing::debug!(%error, "the stream of alerts cannot be made here; the hub makes it");
            }
            tokio::time::sleep(retry).await;
            retry = (retry * 2).min(SLOWEST_RETRY);
        }
        counter!(metric::FLEET_ALERTS, "outcome" => "stored").increment(1);
        journal.attempted(Attempt {
            seq: row.seq,
            endpoint: ENDPOINT.to_owned(),
            at: Timestamp::now(),
            outcome: Outcome::Sent,
        });
    }

    async fn publish(&self, context: &jetstream::Context, journal: &Journal, seq: u64) -> Result<(), String> {
        let reader = journal.clone();
        let found = tokio::task::spawn_blocking(move || reader.event(seq)).await;
        let Some(recorded) = found.map_err(|e| e.to_string())?.map_err(|e| e.to_string())? else {
            tracing::warn!(seq, "an alert event is gone from the journal, by age");
            return Ok(());
        };
        let message = AlertMessage::new(self.name.clone(), journal.id(), recorded);
        let body = serde_json::to_vec(&message).map_err(|e| e.to_string())?;
        let mut headers = HeaderMap::new();
        headers.insert(header::NATS_MESSAGE_ID, journal.event_id(seq));
        let sent = context.publish_with_headers(self.subject(Topic::Alert), headers, body.into());
        let stored = sent.await.map_err(|e| e.to_string())?;
        stored.await.map(|_| ()).map_err(|e| e.to_string())
    }

    /// The newest positions, at most `positions_hz` times a second, and with them the pose that they were found with.
    async fn positions(&self, client: &Client, feed: &Feed) {
        let mut head = feed.subscribe();
        let mut interval = tokio::time::interval(Duration::from_secs_f64(1.0 / self.config.positions_hz));
        interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut last_seq = 0;
        loop {
            interval.tick().await;
            let latest = loop {
                match feed.latest() {
                    Some(latest) if latest.seq > last_seq => break latest,
                    _ if head.changed().await.is_err() => return,
                    _ => {}
                }
            };
            last_seq = latest.seq;
            self.send(client, Topic::Positions, &self.positions_of(&latest)).await;
            if let Some(pose) = self.pose_of(&latest) {
                self.send(client, Topic::Pose, &pose).await;
            }
        }
    }

    fn positions_of(&self, latest: &Published) -> PositionsMessage {
        let report = &latest.snapshot.report;
        let view = latest.snapshot.status.view.as_ref();
        let claims: Vec<&Claim> = latest.claims_in_view().collect();
        let raised = |beam: &TrackedPosition| match view {
            Some(view) => at_claimed_height(beam.clone(), &claims, [view.nadir_m[0], view.nadir_m[1], view.z_m]),
            None => beam.clone(),
        };
        PositionsMessage {
            version: VERSION,
            name: self.name.clone(),
            time: report.time,
            frame: report.frame,
            emitters: report.emitters.iter().map(raised).collect(),
            unseen: report.unseen.clone(),
            claims: claims.into_iter().cloned().collect(),
            field_of_view_m: latest.snapshot.status.field_of_view_m,
            footprint_m: view.map(|view| view.footprint_m.clone()).unwrap_or_default(),
        }
    }

    /// Nothing of a fixed platform.
    fn pose_of(&self, latest: &Published) -> Option<PoseMessage> {
        let status = latest.snapshot.pose.as_ref();
        let status = status.filter(|status| status.source != PlatformKind::Fixed.name())?;
        Some(PoseMessage {
            version: VERSION,
            name: self.name.clone(),
            status: status.clone(),
        })
    }

    async fn health(&self, client: &Client, journal: &Journal, feed: &Feed) {
        let mut interval = tokio::time::interval(HEALTH);
        interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            interval.tick().await;
            let reader = journal.clone();
            let record = tokio::task::spawn_blocking(move || reader.endpoint(ENDPOINT)).await;
            let alerts_waiting = record.ok().and_then(Result::ok).map_or(0, |record| record.waiting);
            let is_connected = client.connection_state() == State::Connected;
            gauge!(metric::FLEET_CONNECTED).set(f64::from(u8::from(is_connected)));
            gauge!(metric::FLEET_WAITING).set(alerts_waiting as f64);
            let status = feed.latest().map(|latest| {
                let mut status = latest.snapshot.status.clone();
                // The footprint comes with the positions, the place with the pose.
                status.view = None;
                serde_json::to_value(status)
            });
            let message = HealthMessage {
                version: VERSION,
                name: self.name.clone(),
                time: Timestamp::now(),
                status: status.and_then(Result::ok).unwrap_or_default(),
                alerts_waiting,
            };
            self.send(client, Topic::Health, &message).await;
        }
    }

    /// Publishes where there is a link; without one the client would keep old messages for it.
    async fn send(&self, client: &Client, topic: Topic, message: &impl serde::Serialize) {
        if client.connection_state() != State::Connected {
            return;
        }
        let body = serde_json::to_vec(message).expect("messages hold no maps with keys other than strings");
        let outcome = match client.publish(self.subject(topic), body.into()).await {
            Ok(()) => "sent",
            Err(error) => {
                tracing::debug!(topic = topic.name(), %error, "a message is not published");
                "failed"
            }
        };
        counter!(metric::FLEET_MESSAGES, "topic" => topic.name(), "outcome" => outcome).increment(1);
    }
}
