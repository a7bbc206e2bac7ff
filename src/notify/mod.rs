//! Layer 4: alert events to receivers, at least once, in order per alert, from a durable outbox. Signed webhooks are one form of
//! delivery; `export/` adds other systems' as further [`Channel`]s.
//!
//! The journal writes an outbox row with each alert event, in the same transaction; [`spawn`]'s worker sends
//! what waits there until the receiver has confirmed it. docs/webhooks.md is the receiver's side of it.

mod channel;
mod client;
#[allow(clippy::disallowed_methods, reason = "the clock of deliveries, which tests speed up")]
mod clock;
mod config;
mod cooling;
mod endpoint;
mod error;
mod http;
mod payload;
mod queue;
mod schedule;
mod signature;
mod status;
mod worker;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::journal::{DeadLetter, Journal};
use worker::{Command, Worker};

pub use channel::{Cause, Channel, Failure, Message, Verdict};
pub use client::judge;
pub use clock::Clock;
pub use config::Config;
pub use endpoint::{Endpoint, check_common, is_loopback, load, name_of, names, shown_url};
pub use error::{AskError, CommonError, Error};
pub use payload::test_event;
pub use status::{EndpointState, EndpointStatus, TestOutcome};
pub use worker::send_test;

/// How long a replay waits for a busy disk, and how often it looks.
const REPLAY_TIMEOUT: Duration = Duration::from_secs(3);
const REPLAY_POLL: Duration = Duration::from_millis(100);

/// A handle on the webhook worker, for the API.
#[derive(Clone)]
pub struct Notifier {
    shown: Arc<Mutex<Vec<EndpointStatus>>>,
    commands: mpsc::Sender<Command>,
    journal: Journal,
}

/// Starts sending. The journal must have been opened with the endpoints' subscriptions. `seed` is the retry
/// jitter's. Once `shutdown` completes, requests that are under way get a few seconds; what is left then waits
/// in the journal for the next start.
pub fn spawn(
    endpoints: Vec<Endpoint>,
    journal: Journal,
    clock: Clock,
    seed: u64,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> (Notifier, JoinHandle<()>) {
    let shown = Arc::new(Mutex::new(endpoints.iter().map(EndpointStatus::new).collect()));
    let (commands, receiver) = mpsc::channel(16);
    let rng = ChaCha8Rng::seed_from_u64(seed);
    let worker = Worker::new(endpoints, journal.clone(), clock, rng, receiver, shown.clone());
    let notifier = Notifier {
        shown,
        commands,
        journal,
    };
    (notifier, tokio::spawn(worker.run(shutdown)))
}

impl Notifier {
    /// Status of each endpoint, in the order of the config.
    pub fn status(&self) -> Vec<EndpointStatus> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Deliveries that the schedule gave up on, oldest first.
    pub fn dead_letters(&self, endpoint: &str, limit: usize) -> Result<Vec<DeadLetter>, AskError> {
        self.known(endpoint)?;
        Ok(self.journal.dead_letters(endpoint, limit)?)
    }

    /// Sends to an endpoint again that had answered 410 Gone.
    pub async fn enable(&self, endpoint: &str) -> Result<(), AskError> {
        let endpoint = self.known(endpoint)?;
        self.ask(|done| Command::Enable { endpoint, done }).await
    }

    /// Puts one dead letter, or all of them, back into the queue; gives how many. They go out beside later
    /// events of their alert that were sent meanwhile: the order is then the operator's.
    pub async fn replay(&self, endpoint: &str, seq: Option<u64>) -> Result<u64, AskError> {
        let endpoint = self.known(endpoint)?;
        // A disk that is only busy is back within a moment.
        let mut waited = Duration::ZERO;
        while !self.journal.health().writable {
            if waited >= REPLAY_TIMEOUT {
                return Err(AskError::ReadOnly);
            }
            tokio::time::sleep(REPLAY_POLL).await;
            waited += REPLAY_POLL;
        }
        self.ask(|done| Command::Replay { endpoint, seq, done }).await
    }

    /// Sends an event that is marked as a test, and gives what came back.
    pub async fn test(&self, endpoint: &str) -> Result<TestOutcome, AskError> {
        let endpoint = self.known(endpoint)?;
        self.ask(|done| Command::Test { endpoint, done }).await?
    }

    /// Sends to these endpoints from now on. Those that stay, by name, keep their queue; what waits for the others stays in the
    /// journal.
    pub async fn replace(&self, endpoints: Vec<Endpoint>) -> Result<(), AskError> {
        self.ask(|done| Command::Replace { endpoints, done }).await
    }

    fn known(&self, name: &str) -> Result<String, AskError> {
        let is_known = self.status().iter().any(|endpoint| endpoint.name == name);
        let unknown = || AskError::Unknown(name.chars().take(64).collect());
        is_known.then(|| name.to_owned()).ok_or_else(unknown)
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, AskError> {
        let (done, answer) = oneshot::channel();
        self.commands
            .send(command(done))
            .await
            .map_err(|_| AskError::Stopping)?;
        answer.await.map_err(|_| AskError::Stopping)
    }
}
