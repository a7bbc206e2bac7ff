//! Where the hub hears: the subjects that are latest-wins, and the stream of alerts.

use std::time::Duration;

use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::{Client, Subscriber, jetstream};
use futures_util::StreamExt;
use tokio::sync::mpsc;

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

/// Reads the stream of alerts from where an earlier run ended, for ever.
pub async fn consume(client: Client, site: Option<String>, alerts: mpsc::Sender<jetstream::Message>) {
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
