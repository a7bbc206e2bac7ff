//! The connection to the NATS server and the stream that keeps alerts.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::stream;
use async_nats::{Client, ConnectOptions, Event, jetstream};
use governor::{DefaultDirectRateLimiter, Quota, RateLimiter};
use metrics::counter;
use nkeys::KeyPair;

use super::config::{Config, ConfigError};
use super::subject::{Subject, Topic};
use crate::{metric, small_file};

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

/// Log lines of each kind that comes with every message or attempt.
const TOLD: Quota = Quota::per_minute(NonZeroU32::MIN);

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("fleet.{key}: {path}: {source}")]
    File {
        key: &'static str,
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("fleet.{key}: {path}: expected {expected}, found: {found}")]
    Proof {
        key: &'static str,
        path: PathBuf,
        expected: &'static str,
        found: String,
    },
    #[error("fleet.url: {0}")]
    Connect(#[from] async_nats::ConnectError),
    #[error("the stream {STREAM}: {0}")]
    Stream(String),
}

/// The server, and what proves who we are to it: the files that the config names have been read.
#[derive(Clone)]
pub struct Access {
    url: String,
    options: ConnectOptions,
}

impl Access {
    pub fn read(config: &Config) -> Result<Self, Error> {
        let mut options = ConnectOptions::new();
        if let Some(path) = &config.credentials_file {
            let key = "credentials_file";
            options = options.credentials(&read(key, path)?).map_err(|error| Error::Proof {
                key,
                path: path.clone(),
                expected: "a user's credentials as `nsc` writes them",
                found: error.to_string(),
            })?;
        }
        if let Some(path) = &config.nkey_file {
            let key = "nkey_file";
            let seed = read(key, path)?.trim().to_owned();
            KeyPair::from_seed(&seed).map_err(|error| Error::Proof {
                key,
                path: path.clone(),
                expected: "a seed as `oapwatch nkey` writes it",
                found: error.to_string(),
            })?;
            options = options.nkey(seed);
        }
        if let Some(path) = &config.ca_file {
            read("ca_file", path)?;
            options = options.add_root_certificates(path.clone()).require_tls(true);
        }
        Ok(Self {
            url: config.url.clone().unwrap_or_default(),
            options,
        })
    }

    /// Connects in the background, for ever: the client is usable at once, and a link that is lost is taken up again. Answers come to
    /// subjects below `_INBOX.<name>`, so that the server can keep those of others from us. Of each subscription `capacity` messages wait
    /// at most.
    pub async fn connect(&self, name: String, capacity: usize) -> Result<Client, Error> {
        let log = Arc::new(Log {
            url: self.url.clone(),
            refusals: RateLimiter::direct(TOLD),
            failures: RateLimiter::direct(TOLD),
        });
        let options = self.options.clone();
        let options = options
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
            .event_callback(move |event| {
                log.say(&event);
                std::future::ready(())
            });
        Ok(options.connect(&self.url).await?)
    }
}

fn read(key: &'static str, path: &Path) -> Result<String, Error> {
    small_file::read(path).map_err(|source| Error::File {
        key,
        path: path.to_owned(),
        source,
    })
}

/// What happens to a connection, for the log.
struct Log {
    url: String,
    refusals: DefaultDirectRateLimiter,
    failures: DefaultDirectRateLimiter,
}

impl Log {
    fn say(&self, event: &Event) {
        let url = self.url.as_str();
        match event {
            Event::Connected => tracing::info!(url, "connected to the NATS server"),
            Event::Disconnected => tracing::warn!(url, "the NATS server is gone; alerts wait in the journal"),
            Event::SlowConsumer(_) => {
                counter!(metric::FLEET_MESSAGES, "topic" => "heard", "outcome" => "dropped").increment(1);
            }
            // Such as a subject that the server's config leaves to another station: one for each message.
            Event::ServerError(error) => {
                counter!(metric::FLEET_MESSAGES, "topic" => "any", "outcome" => "refused").increment(1);
                if self.refusals.check().is_ok() {
                    tracing::warn!(url, %error, "the NATS server refuses (told once a minute): does it know the key of this site and station?");
                }
            }
            // Each attempt that fails.
            Event::ClientError(error) if self.failures.check().is_ok() => {
                tracing::warn!(url, %error, "no connection to the NATS server (told once a minute): is it there, and is its certificate signed by fleet.ca_file?");
            }
            other => tracing::debug!(url, %other, "NATS"),
        }
    }
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
