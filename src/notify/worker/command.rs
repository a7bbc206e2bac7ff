//! What operators ask of the worker: enable, replay, test, and other endpoints after a reload.

use std::time::Duration;

use reqwest::StatusCode;
use tokio::sync::oneshot;

use super::Worker;
use crate::journal::{self, Journal};
use crate::notify::channel::{Failure, Message, Verdict};
use crate::notify::status::TestOutcome;
use crate::notify::{AskError, Clock, Endpoint, payload};

/// Test events to one endpoint: often enough while somebody sets a receiver up, and no means to flood it.
const TEST_EVERY: Duration = Duration::from_secs(5);
/// Longest wait for the answer to a test event while a request to the API waits for it, which itself ends after 15 s unless configured.
const REQUEST_WAITS: Duration = Duration::from_secs(10);

/// What an operator asks of the worker.
pub(in crate::notify) enum Command {
    Enable {
        endpoint: String,
        done: oneshot::Sender<()>,
    },
    Replay {
        endpoint: String,
        seq: Option<u64>,
        done: oneshot::Sender<u64>,
    },
    Test {
        endpoint: String,
        done: oneshot::Sender<Result<TestOutcome, AskError>>,
    },
    /// Other endpoints from now on. Those that stay, by name, keep what waits.
    Replace {
        endpoints: Vec<Endpoint>,
        done: oneshot::Sender<()>,
    },
}

impl Worker {
    async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(&Journal) -> Result<T, journal::Error> + Send + 'static,
    ) -> Result<T, journal::Error> {
        let journal = self.journal.clone();
        match tokio::task::spawn_blocking(move || question(&journal)).await {
            Ok(answer) => answer,
            Err(error) => std::panic::resume_unwind(error.into_panic()),
        }
    }

    pub(super) async fn handle_command(&mut self, command: Command) {
        match command {
            Command::Enable { endpoint, done } => {
                let Some(k) = self.named(&endpoint) else { return };
                self.journal.enable(&endpoint).await;
                let now = self.clock.uptime();
                self.lanes[k].queue.enable(now);
                self.show(now);
                // Whoever asked may have gone away meanwhile.
                let _ = done.send(());
            }
            Command::Replay {
                endpoint: name,
                seq,
                done,
            } => {
                let Some(endpoint) = self.named(&name) else { return };
                self.journal.replay(&name, seq, self.clock.now()).await;
                let before = self.lanes[endpoint].queue.len();
                match self.ask(move |journal| journal.waiting(&name, 0)).await {
                    Ok(rows) => {
                        // Later events come in by `read_new`, once.
                        let read_to = self.lanes[endpoint].read_to;
                        for row in rows.iter().filter(|row| row.seq <= read_to) {
                            if !self.lanes[endpoint].cool_down.holds(row.seq) {
                                self.lanes[endpoint].push(row);
                            }
                        }
                    }
                    Err(error) => tracing::warn!(%error, "the webhook outbox cannot be read"),
                }
                let lane = &mut self.lanes[endpoint];
                let revived = (lane.queue.len() - before) as u64;
                lane.status.failed = lane.status.failed.saturating_sub(revived);
                self.show(self.clock.uptime());
                let _ = done.send(revived);
            }
            Command::Test { endpoint, done } => {
                let now = self.clock.uptime();
                let Some(k) = self.named(&endpoint) else { return };
                let lane = &mut self.lanes[k];
                let next = lane.tested_at.map_or(Duration::ZERO, |at| at + TEST_EVERY);
                if now < next {
                    let _ = done.send(Err(AskError::TooSoon((next - now).as_secs() + 1)));
                    return;
                }
                lane.tested_at = Some(now);
                let (endpoint, journal, clock) = (lane.endpoint.clone(), self.journal.clone(), self.clock);
                tokio::spawn(
                    async move { done.send(Ok(send_test(&endpoint, journal.id(), clock, REQUEST_WAITS).await)) },
                );
            }
            Command::Replace { endpoints, done } => {
                let before: Vec<String> = self.lanes.iter().map(|lane| lane.endpoint.name.clone()).collect();
                let subscriptions: Vec<_> = endpoints.iter().map(Endpoint::subscription).collect();
                self.journal.resubscribe(&before, &subscriptions);
                self.replace(endpoints);
                self.show(self.clock.uptime());
                let _ = done.send(());
            }
        }
    }
}

/// Sends a test event like any other, but once and beside the queue, and waits for the answer as long as for any, `longest` at most.
/// `journal` is the name in its id.
pub async fn send_test(endpoint: &Endpoint, journal: &str, clock: Clock, longest: Duration) -> TestOutcome {
    let now = clock.now();
    let id = format!("msg_{journal}_test_{}", now.as_millisecond());
    let began = clock.uptime();
    let message = Message {
        id: &id,
        event: &payload::test_event(now),
        is_test: true,
        now,
    };
    let (status, failure) = match super::deliver(endpoint, message, endpoint.timeout.min(longest)).await {
        Verdict::Delivered(status) => (status, None),
        Verdict::Gone | Verdict::Expired => (Some(StatusCode::GONE), Some(Failure::Status(StatusCode::GONE))),
        Verdict::Failed { failure, .. } => (failure.status(), Some(failure)),
    };
    TestOutcome {
        delivered: failure.is_none(),
        status: status.map(|status| status.as_u16()),
        took_ms: (clock.uptime() - began).as_millis() as u64,
        error: failure.map(|failure| failure.to_string()),
    }
}
