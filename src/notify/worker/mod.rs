//! The delivery loop: takes due deliveries from every endpoint's queue, sends them and notes the outcome.

mod command;
mod lane;

use std::collections::HashMap;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use metrics::{counter, gauge};
use rand_chacha::ChaCha8Rng;
use tokio::sync::mpsc;
use tokio::task::{Id, JoinError, JoinSet};

use super::channel::{Failure, Message, Verdict};
use super::queue::Next;
use super::status::{EndpointState, EndpointStatus};
use super::{Clock, Endpoint};
use crate::journal::{Attempt, Journal, Outcome};
use crate::metric;
pub(super) use command::Command;
pub use command::send_test;
use lane::{Found, Lane};

/// How long requests that are under way may still take when the daemon stops.
const GRACE: Duration = Duration::from_secs(3);

/// How often the age of the oldest delivery is brought up to date.
const TICK: Duration = Duration::from_secs(10);

/// All endpoints, their requests and their reads of the journal.
pub(super) struct Worker {
    lanes: Vec<Lane>,
    journal: Journal,
    clock: Clock,
    rng: ChaCha8Rng,
    commands: mpsc::Receiver<Command>,
    shown: Arc<Mutex<Vec<EndpointStatus>>>,
    /// Looks at the disk.
    reads: JoinSet<(u64, Found)>,
    requests: JoinSet<Verdict>,
    /// Lane and event of each request.
    under_way: HashMap<Id, (u64, u64)>,
    /// Lanes so far.
    begun: u64,
}

impl Worker {
    pub(super) fn new(
        endpoints: Vec<Endpoint>,
        journal: Journal,
        clock: Clock,
        rng: ChaCha8Rng,
        commands: mpsc::Receiver<Command>,
        shown: Arc<Mutex<Vec<EndpointStatus>>>,
    ) -> Self {
        let mut worker = Self {
            lanes: Vec::new(),
            begun: 0,
            journal,
            clock,
            rng,
            commands,
            shown,
            reads: JoinSet::new(),
            requests: JoinSet::new(),
            under_way: HashMap::new(),
        };
        worker.replace(endpoints);
        worker
    }

    /// Takes these endpoints in place of those before. What waits for one that is gone stays in the journal.
    fn replace(&mut self, endpoints: Vec<Endpoint>) {
        let begun_at = self.journal.last_seq();
        let mut before = std::mem::take(&mut self.lanes);
        for endpoint in endpoints.into_iter().map(Arc::new) {
            let kept = before.iter().position(|lane| lane.endpoint.name == endpoint.name);
            let lane = match kept {
                Some(k) => {
                    let mut lane = before.swap_remove(k);
                    lane.change(endpoint);
                    lane
                }
                None => {
                    self.begun += 1;
                    Lane::new(self.begun, endpoint, self.journal.clone(), self.clock, begun_at)
                }
            };
            self.lanes.push(lane);
        }
        for lane in before {
            let name = lane.endpoint.name.clone();
            for metric in [
                metric::WEBHOOK_QUEUED,
                metric::WEBHOOK_OLDEST,
                metric::WEBHOOK_DEAD_LETTERS,
            ] {
                gauge!(metric, "endpoint" => name.clone()).set(0.0);
            }
        }
    }

    fn lane(&mut self, id: u64) -> Option<&mut Lane> {
        self.lanes.iter_mut().find(|lane| lane.id == id)
    }

    fn named(&self, name: &str) -> Option<usize> {
        self.lanes.iter().position(|lane| lane.endpoint.name == name)
    }

    pub(super) async fn run(mut self, shutdown: impl Future<Output = ()>) {
        let mut shutdown = pin!(shutdown);
        let mut heard = self.journal.heard();
        loop {
            heard.mark_unchanged();
            self.look();
            let now = self.clock.uptime();
            for lane in &mut self.lanes {
                lane.release_held(now);
            }
            self.start(now);
            self.show(now);
            let wakes = self
                .lanes
                .iter()
                .flat_map(|lane| [lane.queue.wake_at(), lane.cool_down.wake_at()])
                .flatten();
            // What is due already waits for a request that is under way.
            let wake = wakes
                .filter(|&at| at > now)
                .min()
                .unwrap_or(Duration::MAX)
                .min(now + TICK);
            tokio::select! {
                () = &mut shutdown => break,
                Some(ended) = self.requests.join_next_with_id(), if !self.requests.is_empty() => self.settle(ended),
                Some(Ok((id, found))) = self.reads.join_next(), if !self.reads.is_empty() => {
                    if let Some(lane) = self.lane(id) {
                        lane.found(found);
                    }
                }
                Ok(()) = heard.changed() => {}
                Some(command) = self.commands.recv() => self.handle_command(command).await,
                () = self.clock.sleep_until(wake) => {}
            }
        }
        // What is cut off here stays in the outbox and goes out after the next start.
        let grace = tokio::time::sleep(GRACE);
        let mut grace = pin!(grace);
        while !self.requests.is_empty() {
            tokio::select! {
                () = &mut grace => break,
                Some(ended) = self.requests.join_next_with_id() => self.settle(ended),
            }
        }
        self.journal.settled().await;
    }

    /// Takes new events into the queues; reads of the disk run beside.
    fn look(&mut self) {
        for lane in &mut self.lanes {
            let id = lane.id;
            if let Some(read) = lane.look() {
                self.reads.spawn(async move { (id, read.await) });
            }
        }
    }

    fn start(&mut self, now: Duration) {
        for lane in &mut self.lanes {
            while let Some(job) = lane.queue.take(now) {
                let request = attempt(self.journal.clone(), lane.endpoint.clone(), job.seq, self.clock);
                let id = self.requests.spawn(request).id();
                self.under_way.insert(id, (lane.id, job.seq));
            }
        }
    }

    fn settle(&mut self, ended: Result<(Id, Verdict), JoinError>) {
        let (id, verdict) = ended.unwrap_or_else(|error| (error.id(), Failure::Broken.into()));
        let Some((of, seq)) = self.under_way.remove(&id) else {
            return;
        };
        let (at, now) = (self.clock.now(), self.clock.uptime());
        // Where the endpoint is gone the delivery waits in the journal.
        let Some(lane) = self.lanes.iter_mut().find(|lane| lane.id == of) else {
            return;
        };
        let name = lane.endpoint.name.as_str();
        let count = |outcome: &'static str| {
            counter!(metric::WEBHOOK_ATTEMPTS, "endpoint" => name.to_owned(), "outcome" => outcome).increment(1);
        };
        let was_failing = lane.queue.is_failing();
        let (next, error) = match verdict {
            Verdict::Delivered(_) => {
                count("delivered");
                lane.status.sent += 1;
                lane.status.last_success = Some(at);
                if was_failing {
                    tracing::info!(
                        endpoint = name,
                        queued = lane.queue.len(),
                        "the webhook receiver answers again"
                    );
                }
                (lane.queue.sent(seq, now), String::new())
            }
            Verdict::Gone => {
                count("gone");
                let error = Failure::Status(reqwest::StatusCode::GONE).to_string();
                tracing::warn!(
                    endpoint = name,
                    "the webhook receiver answered 410 Gone; nothing more is sent until it is enabled"
                );
                self.journal.disable(name, at, error.clone());
                (lane.queue.gone(seq, now), error)
            }
            Verdict::Expired => {
                lane.queue.expired(seq, now);
                tracing::warn!(
                    endpoint = name,
                    seq,
                    "a webhook delivery is gone from the journal, by age"
                );
                return;
            }
            Verdict::Failed { failure, retry_after } => {
                count("failed");
                let error = failure.to_string();
                match was_failing {
                    true => tracing::debug!(endpoint = name, seq, %error, "a webhook delivery failed again"),
                    false => {
                        tracing::warn!(endpoint = name, seq, %error, "a webhook delivery failed; it is tried again")
                    }
                }
                (lane.queue.failed(seq, retry_after, now, &mut self.rng), error)
            }
        };
        if next != Next::Sent {
            lane.status.last_failure = Some(at);
            lane.status.last_error = Some(error.clone());
        }
        let outcome = match next {
            Next::Sent => Outcome::Sent,
            Next::Retry { step, wait } => {
                let wait = SignedDuration::try_from(wait).unwrap_or(SignedDuration::MAX);
                let next_at = at.saturating_add(wait).unwrap_or(Timestamp::MAX);
                Outcome::Retry { step, next_at, error }
            }
            Next::Dead => {
                count("given_up");
                lane.status.failed += 1;
                tracing::error!(endpoint = name, seq, %error, "a webhook delivery is given up; it can be replayed");
                Outcome::Dead { error }
            }
        };
        self.journal.attempted(Attempt {
            seq,
            endpoint: name.to_owned(),
            at,
            outcome,
        });
    }

    /// Brings status and metrics up to date.
    fn show(&mut self, now: Duration) {
        let wall = self.clock.now();
        for lane in &mut self.lanes {
            let status = &mut lane.status;
            status.state = match (lane.queue.is_disabled(), lane.queue.is_failing()) {
                (true, _) => EndpointState::Disabled,
                // After a start the first request of a queue goes alone, though nothing has failed.
                (false, true) if status.last_error.is_some() => EndpointState::Failing,
                (false, _) => EndpointState::Working,
            };
            status.queued = (lane.queue.len() + lane.cool_down.len()) as u64;
            status.oldest_queued = lane.queue.oldest();
            status.next_attempt = lane.queue.wake_at().map(|at| {
                let wait = SignedDuration::try_from(at.saturating_sub(now)).unwrap_or(SignedDuration::MAX);
                wall.saturating_add(wait).unwrap_or(Timestamp::MAX)
            });
            let age = status
                .oldest_queued
                .map_or(0.0, |at| wall.duration_since(at).as_secs_f64().max(0.0));
            let name = lane.endpoint.name.as_str();
            gauge!(metric::WEBHOOK_QUEUED, "endpoint" => name.to_owned()).set(status.queued as f64);
            gauge!(metric::WEBHOOK_OLDEST, "endpoint" => name.to_owned()).set(age);
            gauge!(metric::WEBHOOK_DEAD_LETTERS, "endpoint" => name.to_owned()).set(status.failed as f64);
        }
        *self.shown.lock().unwrap_or_else(PoisonError::into_inner) =
            self.lanes.iter().map(|lane| lane.status.clone()).collect();
    }
}

async fn attempt(journal: Journal, endpoint: Arc<Endpoint>, seq: u64, clock: Clock) -> Verdict {
    let id = journal.event_id(seq);
    let found = tokio::task::spawn_blocking(move || journal.event(seq)).await;
    let event = match found {
        Ok(Ok(Some(event))) => event,
        Ok(Ok(None)) => return Verdict::Expired,
        Ok(Err(error)) => return Failure::Journal(error).into(),
        Err(_) => return Failure::Broken.into(),
    };
    let message = Message {
        id: &id,
        event: &event,
        is_test: false,
        now: clock.now(),
    };
    deliver(&endpoint, message, endpoint.timeout).await
}

/// One attempt, which ends in time.
async fn deliver(endpoint: &Endpoint, message: Message<'_>, timeout: Duration) -> Verdict {
    let delivery = endpoint.channel.deliver(message);
    tokio::time::timeout(timeout, delivery)
        .await
        .unwrap_or_else(|_| Failure::Timeout.into())
}
