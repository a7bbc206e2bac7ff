//! One endpoint's deliveries: from the journal's outbox, past the cool-down, into the queue.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use metrics::counter;

use crate::journal::{self, Attempt, EndpointRecord, Journal, Outcome, Recorded, Waiting};
use crate::metric;
use crate::notify::clock::Clock;
use crate::notify::cooling::{CoolDown, Ruling};
use crate::notify::endpoint::Endpoint;
use crate::notify::queue::Queue;
use crate::notify::schedule;
use crate::notify::status::EndpointStatus;

/// Time after which a journal that could not be read is read again.
const REREAD: Duration = Duration::from_secs(1);

/// A delivery and, where a cool-down has to judge it, its event.
type Delivery = (Option<Recorded>, Waiting);

/// What the disk answered.
pub(super) struct Found {
    /// The last event when it was asked.
    last: u64,
    answer: Result<(EndpointRecord, Vec<Delivery>), journal::Error>,
}

/// One endpoint's deliveries.
pub(super) struct Lane {
    /// Of no other lane, before or after a reload.
    pub(super) id: u64,
    /// When an operator last sent a test event.
    pub(super) tested_at: Option<Duration>,
    pub(super) endpoint: Arc<Endpoint>,
    pub(super) queue: Queue,
    pub(super) cool_down: CoolDown,
    pub(super) status: EndpointStatus,
    /// Events up to this one are in the queue, or done with.
    pub(super) read_to: u64,
    journal: Journal,
    clock: Clock,
    /// The last event when this run began.
    begun_at: u64,
    /// Whether the deliveries that an earlier run left are in the queue.
    is_known: bool,
    /// Whether the disk has been asked and has not answered.
    is_reading: bool,
    /// Events after `read_to` of which the same is true, from memory while the disk does not answer.
    ahead: BTreeSet<u64>,
}

impl Lane {
    pub(super) fn new(id: u64, endpoint: Arc<Endpoint>, journal: Journal, clock: Clock, begun_at: u64) -> Self {
        Self {
            id,
            tested_at: None,
            status: EndpointStatus::new(&endpoint),
            cool_down: CoolDown::new(endpoint.cool_down),
            endpoint,
            queue: Queue::default(),
            read_to: 0,
            journal,
            clock,
            begun_at,
            is_known: false,
            is_reading: false,
            ahead: BTreeSet::new(),
        }
    }

    /// Goes on with another address, secret, selection of kinds or cool-down; what waits stays.
    pub(super) fn change(&mut self, endpoint: Arc<Endpoint>) {
        let shown = EndpointStatus::new(&endpoint);
        self.status.url = shown.url;
        self.status.kind = shown.kind;
        self.status.kinds = shown.kinds;
        self.cool_down.set_period(endpoint.cool_down);
        self.endpoint = endpoint;
    }

    fn advance(&mut self, read_to: u64) {
        self.read_to = read_to;
        self.ahead.retain(|&seq| seq > read_to);
    }

    /// Takes the deliveries of new events into the queue: those that memory holds at once. Gives a read of the disk where the
    /// rest is there, to be run beside other work; [`Lane::found`] takes its answer, however late.
    pub(super) fn look(&mut self) -> Option<impl Future<Output = Found> + Send + use<>> {
        let last = self.journal.last_seq();
        if self.is_known && self.read_to >= last {
            return None;
        }
        let (name, after) = (self.endpoint.name.clone(), self.read_to);
        let (is_cooled, begun_at) = (!self.cool_down.is_off(), self.begun_at);
        let held = self.journal.waiting_in_memory(&name, after).and_then(|(rows, is_all)| {
            let rows = rows.into_iter().filter(|row| !self.ahead.contains(&row.seq)).collect();
            Ok((with_events(&self.journal, rows, is_cooled)?, is_all))
        });
        match held {
            Ok((rows, is_all)) => {
                let read_to = rows.last().map_or(last, |(_, row)| row.seq.max(last));
                self.ahead.extend(rows.iter().map(|(_, row)| row.seq));
                self.take_in(rows);
                if is_all && self.is_known && !self.is_reading {
                    self.advance(read_to);
                    return None;
                }
            }
            Err(error) => tracing::warn!(%error, "the webhook outbox in memory cannot be read"),
        }
        if std::mem::replace(&mut self.is_reading, true) {
            return None;
        }
        let journal = self.journal.clone();
        Some(async move {
            let question = move || {
                let rows = with_events(&journal, journal.waiting(&name, after)?, is_cooled)?;
                // What this run has sent since it counts itself.
                Ok((journal.endpoint_until(&name, begun_at)?, rows))
            };
            let answer = tokio::task::spawn_blocking(question).await;
            let answer = answer.unwrap_or(Err(journal::Error::Panicked));
            if answer.is_err() {
                tokio::time::sleep(REREAD).await;
            }
            Found { last, answer }
        })
    }

    /// Takes in what the disk answered.
    pub(super) fn found(&mut self, found: Found) {
        let Found { last, answer } = found;
        self.is_reading = false;
        let (record, mut rows) = match answer {
            Ok(answer) => answer,
            Err(error) => {
                tracing::warn!(%error, "the webhook outbox cannot be read");
                return;
            }
        };
        let read_to = rows.last().map_or(last, |(_, row)| row.seq.max(last));
        rows.retain(|(_, row)| !self.ahead.contains(&row.seq));
        self.take_in(rows);
        self.advance(read_to);
        if !std::mem::replace(&mut self.is_known, true) {
            self.resume(record);
        }
    }

    /// Continues with the record of an earlier run.
    fn resume(&mut self, record: EndpointRecord) {
        let now = self.clock.uptime();
        let status = &mut self.status;
        status.sent += record.sent;
        status.failed += record.dead;
        status.last_success = status.last_success.max(record.last_success);
        status.last_failure = status.last_failure.max(record.last_failure);
        status.last_error = status.last_error.take().or(record.last_error);
        if record.disabled_at.is_some() {
            tracing::warn!(
                endpoint = self.endpoint.name.as_str(),
                "this webhook's receiver answered 410 Gone; nothing is sent until it is enabled"
            );
            self.queue.disable();
        } else if self.queue.len() > 0 {
            self.queue.probe_first(now);
        }
    }

    fn take_in(&mut self, rows: Vec<Delivery>) {
        for (event, row) in rows {
            self.cool(event, row);
        }
    }

    /// Queues a new delivery, holds it back, or withholds it for good.
    fn cool(&mut self, event: Option<Recorded>, row: Waiting) {
        let now = self.clock.uptime();
        let ruling = match event {
            Some(event) => self.cool_down.judge(row, &event.event, now),
            None => Ruling::Send(vec![row]),
        };
        match ruling {
            Ruling::Hold => {}
            Ruling::Send(rows) => {
                for row in &rows {
                    self.push(row);
                }
            }
            Ruling::Withhold(rows) => {
                self.status.withheld += rows.len() as u64;
                let name = &self.endpoint.name;
                counter!(metric::WEBHOOK_ATTEMPTS, "endpoint" => name.clone(), "outcome" => "withheld")
                    .increment(rows.len() as u64);
                for row in rows {
                    self.journal.attempted(Attempt {
                        seq: row.seq,
                        endpoint: row.endpoint,
                        at: self.clock.now(),
                        outcome: Outcome::Withheld,
                    });
                }
            }
        }
    }

    /// Queues what was held back for long enough.
    pub(super) fn release_held(&mut self, now: Duration) {
        for row in self.cool_down.due(now) {
            self.push(&row);
        }
    }

    pub(super) fn push(&mut self, row: &Waiting) {
        // The wall clock may have been set since the row was written: no wait grows beyond its schedule.
        let wait = Duration::try_from(row.next_at.duration_since(self.clock.now())).unwrap_or(Duration::ZERO);
        let due = self.clock.uptime() + wait.min(schedule::longest_wait(row.step));
        self.queue.push(&row.alert, row.seq, row.step, due, row.recorded_at);
    }
}

/// What an event says matters to a cool-down only.
fn with_events(journal: &Journal, rows: Vec<Waiting>, is_cooled: bool) -> Result<Vec<Delivery>, journal::Error> {
    let event = |seq| is_cooled.then(|| journal.event(seq)).transpose();
    rows.into_iter()
        .map(|row| Ok((event(row.seq)?.flatten(), row)))
        .collect()
}
