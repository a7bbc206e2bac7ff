//! The connection to the NATS server and the stream that keeps alerts.

use std::path::Path;
use std::time::Duration;

use async_nats::jetstream::stream;
use async_nats::{Client, ConnectOptions, jetstream};
use metrics::counter;

use super::config::Config;
use super::subject::{Subject, Topic};
use crate::metric;

/// The stream of all alerts.
const STREAM: &str = "OAPWATCH";
/// How long the server recognises an event that is sent twice. A station that lost the answer repeats within its retry interval;
/// the hub recognises later repeats by their number.
const DUPLICATE_WINDOW: Duration = Duration::from_secs(120);
/// How long alerts wait for a hub.
const KEPT: Duration = Duration::from_secs(30 * 24 * 3600);
/// What waits for a hub at most, bytes: some 500,000 events. Then the server refuses new ones, which wait at their stations.
const LARGEST_STREAM: i64 = 1 << 30;
/// Largest alert event, bytes.
const LARGEST_EVENT: i32 = 256 << 10;
/// A dead link is noticed after two of these.
const PING: Duration = Duration::from_secs(10);
/// Messages of a subscription that wait to be read: ten seconds' of a thousand stations.
pub const CAPACITY: usize = 1 << 16;
/// Longest wait between two attempts to connect.
const SLOWEST_RETRY: Duration = Duration::from_secs(5);

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("fleet.{key}: {path}: {source}")]
    File {
        key: &'static str,
        path: std::path::PathBuf,
        source: std::io::Error,
    },
    #[error("fleet.url: {0}")]
    Connect(#[from] async_nats::ConnectError),
    #[error("the stream {STREAM}: {0}")]
    Stream(String),
}

/// Connects in the background, for ever: the client is usable at once, and a link that is lost is taken up again. Answers come to
/// subjects below `_INBOX.<name>`, so that the server can keep those of others from us. Of each subscription `capacity` messages wait
/// at most.
pub async fn connect(config: &Config, name: String, capacity: usize) -> Result<Client, Error> {
    let unreadable = |key: &'static str, path: &Path| {
        let path = path.to_owned();
        move |source| Error::File { key, path, source }
    };
    let mut options = ConnectOptions::new()
        .custom_inbox_prefix(format!("_INBOX.{name}"))
        .name(name)
        .retry_on_initial_connect()
        .subscription_capacity(capacity)
        .ping_interval(PING)
        .reconnect_delay_callback(|attempts| {
            let attempts = u32::try_from(attempts).unwrap_or(u32::MAX);
            Duration::from_millis(100)
                .saturating_mul(2u32.saturating_pow(attempts.min(10)))
                .min(SLOWEST_RETRY)
        })
        .event_callback(|event| async move {
            match event {
                async_nats::Event::Connected => tracing::info!("connected to the NATS server"),
                async_nats::Event::Disconnected => {
                    tracing::warn!("the NATS server is gone; alerts wait in the journal")
                }
                async_nats::Event::SlowConsumer(_) => {
                    counter!(metric::FLEET_MESSAGES, "topic" => "heard", "outcome" => "dropped").increment(1);
                }
                // Such as a subject that the server's config leaves to another station.
                async_nats::Event::ServerError(error) => tracing::warn!(%error, "the NATS server refuses"),
                other => tracing::debug!(%other, "NATS"),
            }
        });
    if let Some(path) = &config.credentials_file {
        options = options
            .credentials_file(path)
            .await
            .map_err(unreadable("credentials_file", path))?;
    }
    if let Some(path) = &config.nkey_file {
        let seed = std::fs::read_to_string(path).map_err(unreadable("nkey_file", path))?;
        options = options.nkey(seed.trim().to_owned());
    }
    if let Some(path) = &config.ca_file {
        std::fs::metadata(path).map_err(unreadable("ca_file", path))?;
        options = options.add_root_certificates(path.clone()).require_tls(true);
    }
    let url = config.url.as_deref().unwrap_or_default();
    Ok(options.connect(url).await?)
}

/// The stream of alerts, made where it is missing and may be made.
pub async fn ensure_stream(context: &jetstream::Context) -> Result<stream::Stream, Error> {
    let config = stream::Config {
        name: STREAM.to_owned(),
        description: Some("Alerts of all oapwatch stations".to_owned()),
        subjects: vec![Subject::of_all(None, Topic::Alert)],
        duplicate_window: DUPLICATE_WINDOW,
        max_age: KEPT,
        max_bytes: LARGEST_STREAM,
        max_message_size: LARGEST_EVENT,
        discard: stream::DiscardPolicy::New,
        ..stream::Config::default()
    };
    let made = context.get_or_create_stream(config).await;
    made.map_err(|e| Error::Stream(e.to_string()))
}
