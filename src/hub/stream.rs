//! Where the hub hears: the subjects that are latest-wins, and the stream of alerts.

use std::time::Duration;

use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, PullConsumer, pull};
use async_nats::jetstream::context::ConsumerInfoErrorKind;
use async_nats::jetstream::stream::Stream;
use async_nats::{Client, Subscriber, jetstream};
use futures_util::StreamExt;
use tokio::sync::{mpsc, watch};

use crate::fleet::{Subject, Topic, ensure_stream};

/// Alert events taken at once; they are confirmed to the server when all of them are on disk.
pub const BATCH: usize = 256;
/// The server delivers an event again that is not confirmed within this time.
const ACK_WAIT: Duration = Duration::from_secs(30);
/// Wait before the stream is asked for again.
const RETRY: Duration = Duration::from_secs(1);
/// Name of the hub's place in the stream.
const CONSUMER: &str = "hub";

/// The link may be down: the subscription stands once it is up.
pub async fn subscribe(client: &Client, site: Option<&str>, topic: Topic) -> Subscriber {
    loop {
        match client.subscribe(Subject::of_all(site, topic)).await {
            Ok(subscriber) => return subscriber,
            Err(error) => tracing::warn!(%error, "the fleet's messages cannot be subscribed to"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// An event, and which attempt at reading the stream gave it.
pub struct Delivered {
    pub message: jetstream::Message,
    pub attempt: u64,
}

/// Reads the stream of alerts from the first event that is not confirmed, for ever; again from there when `attempt` changes.
pub async fn consume(
    client: Client,
    site: Option<String>,
    alerts: mpsc::Sender<Delivered>,
    mut attempt: watch::Receiver<u64>,
) {
    let context = jetstream::new(client);
    let name = site
        .as_ref()
        .map_or(CONSUMER.to_owned(), |site| format!("{CONSUMER}-{site}"));
    let mut is_told = false;
    loop {
        let now = *attempt.borrow_and_update();
        let ended = tokio::select! {
            ended = read(&context, &name, site.as_deref(), now, &alerts) => ended,
            Ok(()) = attempt.changed() => Err("events were lost to the journal".to_owned()),
        };
        match ended {
            Ok(()) => return,
            Err(error) if !std::mem::replace(&mut is_told, true) => {
                tracing::warn!(error, "the stream of alerts cannot be read; it is tried again");
            }
            Err(error) => tracing::debug!(error, "the stream of alerts cannot be read"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn read(
    context: &jetstream::Context,
    name: &str,
    site: Option<&str>,
    attempt: u64,
    alerts: &mpsc::Sender<Delivered>,
) -> Result<(), String> {
    let stream = ensure_stream(context).await.map_err(|e| e.to_string())?;
    let consumer = consumer(&stream, name, site).await?;
    let mut messages = consumer.messages().await.map_err(|e| e.to_string())?;
    let mut number = 0;
    while let Some(message) = messages.next().await {
        let message = message.map_err(|e| e.to_string())?;
        number += 1;
        let given = message.info().map_err(|e| e.to_string())?.consumer_sequence;
        if given != number {
            return Err(format!(
                "expected delivery {number}, found {given}: one was lost on its way"
            ));
        }
        if alerts.send(Delivered { message, attempt }).await.is_err() {
            return Ok(());
        }
    }
    Err("the server ended it".to_owned())
}

/// A new consumer that begins after the last event before which all are confirmed. One that was taken up again would give newer events
/// before those that were under way when a hub or a server was killed, which come again after [`ACK_WAIT`] only; an older event of a
/// station would then be taken for a repeated one. Where a hub is killed between the two requests, the next one reads all of the stream
/// and knows by their numbers what it has.
async fn consumer(stream: &Stream, name: &str, site: Option<&str>) -> Result<PullConsumer, String> {
    let confirmed = match stream.consumer_info(name).await {
        Ok(info) => {
            stream.delete_consumer(name).await.map_err(|e| e.to_string())?;
            info.ack_floor.stream_sequence
        }
        Err(error) if error.kind() == ConsumerInfoErrorKind::NotFound => 0,
        Err(error) => return Err(error.to_string()),
    };
    let start_sequence = confirmed + 1;
    let config = pull::Config {
        durable_name: Some(name.to_owned()),
        deliver_policy: DeliverPolicy::ByStartSequence { start_sequence },
        ack_policy: AckPolicy::Explicit,
        ack_wait: ACK_WAIT,
        max_ack_pending: BATCH as i64,
        filter_subject: Subject::of_all(site, Topic::Alert),
        ..pull::Config::default()
    };
    stream.create_consumer(config).await.map_err(|e| e.to_string())
}
