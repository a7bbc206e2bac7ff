//! From the journal's outbox to an endpoint's queue, past its cool-down.

use std::time::Duration;

use metrics::counter;

use super::Worker;
use super::found::{Delivery, Found};
use crate::journal::{self, Attempt, EndpointRecord, Journal, Outcome, Recorded, Waiting};
use crate::metric;
use crate::notify::cooling::Ruling;
use crate::notify::schedule;

/// How soon a journal that could not be read is read again.
const REREAD: Duration = Duration::from_secs(1);

impl Worker {
    /// Takes the deliveries of new events into the queue: what memory holds at once, the rest when the disk has
    /// answered, however long that takes.
    pub(super) fn look(&mut self, k: usize) {
        let last = self.journal.last_seq();
        let lane = &self.lanes[k];
        if lane.is_known && lane.read_to >= last {
            return;
        }
        let (name, after) = (lane.endpoint.name().to_owned(), lane.read_to);
        let (is_cooled, begun_at) = (!lane.cool_down.is_off(), self.begun_at);
        let held = self.journal.waiting_in_memory(&name, after).and_then(|(rows, is_all)| {
            let rows = rows.into_iter().filter(|row| !lane.ahead.contains(&row.seq)).collect();
            Ok((with_events(&self.journal, rows, is_cooled)?, is_all))
        });
        match held {
            Ok((rows, is_all)) => {
                let read_to = rows.last().map_or(last, |(_, row)| row.seq.max(last));
                self.lanes[k].ahead.extend(rows.iter().map(|(_, row)| row.seq));
                self.take_in(k, rows);
                let lane = &mut self.lanes[k];
                if is_all && lane.is_known && !lane.is_reading {
                    lane.advance(read_to);
                    return;
                }
            }
            Err(error) => tracing::warn!(%error, "the webhook outbox in memory cannot be read"),
        }
        if !std::mem::replace(&mut self.lanes[k].is_reading, true) {
            let journal = self.journal.clone();
            self.reads.spawn(async move {
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
                Found { lane: k, last, answer }
            });
        }
    }

    /// Takes in what the disk answered.
    pub(super) fn found(&mut self, found: Found) {
        let Found { lane: k, last, answer } = found;
        self.lanes[k].is_reading = false;
        let (record, mut rows) = match answer {
            Ok(answer) => answer,
            Err(error) => {
                tracing::warn!(%error, "the webhook outbox cannot be read");
                return;
            }
        };
        let read_to = rows.last().map_or(last, |(_, row)| row.seq.max(last));
        rows.retain(|(_, row)| !self.lanes[k].ahead.contains(&row.seq));
        self.take_in(k, rows);
        let lane = &mut self.lanes[k];
        lane.advance(read_to);
        if !std::mem::replace(&mut lane.is_known, true) {
            self.resume(k, record);
        }
    }

    /// Takes up what an earlier run left behind.
    fn resume(&mut self, k: usize, record: EndpointRecord) {
        let now = self.clock.uptime();
        let lane = &mut self.lanes[k];
        lane.status.sent += record.sent;
        lane.status.failed += record.dead;
        lane.status.last_success = lane.status.last_success.max(record.last_success);
        lane.status.last_failure = lane.status.last_failure.max(record.last_failure);
        lane.status.last_error = lane.status.last_error.take().or(record.last_error);
        if record.disabled_at.is_some() {
            tracing::warn!(
                endpoint = lane.endpoint.name(),
                "this webhook's receiver answered 410 Gone; nothing is sent until it is enabled"
            );
            lane.queue.disable();
        } else if lane.queue.len() > 0 {
            lane.queue.probe_first(now);
        }
    }

    fn take_in(&mut self, k: usize, rows: Vec<Delivery>) {
        for (event, row) in rows {
            self.cool(k, event, row);
        }
    }

    /// Queues a new delivery, holds it back, or keeps it from the receiver for good.
    fn cool(&mut self, k: usize, event: Option<Recorded>, row: Waiting) {
        let now = self.clock.uptime();
        let ruling = match event {
            Some(event) => self.lanes[k].cool_down.judge(row, &event.event, now),
            None => Ruling::Send(vec![row]),
        };
        match ruling {
            Ruling::Hold => {}
            Ruling::Send(rows) => {
                for row in &rows {
                    self.push(k, row);
                }
            }
            Ruling::Withhold(rows) => {
                let lane = &mut self.lanes[k];
                lane.status.withheld += rows.len() as u64;
                let name = lane.endpoint.name();
                counter!(metric::WEBHOOK_ATTEMPTS, "endpoint" => name.to_owned(), "outcome" => "withheld")
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
        for k in 0..self.lanes.len() {
            for row in self.lanes[k].cool_down.due(now) {
                self.push(k, &row);
            }
        }
    }

    pub(super) fn push(&mut self, k: usize, row: &Waiting) {
        // The wall clock may have been set since the row was written: no wait grows beyond its schedule.
        let wait = Duration::try_from(row.next_at.duration_since(self.clock.now())).unwrap_or(Duration::ZERO);
        let due = self.clock.uptime() + wait.min(schedule::longest_wait(row.step));
        self.lanes[k]
            .queue
            .push(&row.alert, row.seq, row.step, due, row.recorded_at);
    }
}

/// What an event says matters to a cool-down only.
fn with_events(journal: &Journal, rows: Vec<Waiting>, is_cooled: bool) -> Result<Vec<Delivery>, journal::Error> {
    let event = |seq| is_cooled.then(|| journal.event(seq)).transpose();
    rows.into_iter()
        .map(|row| Ok((event(row.seq)?.flatten(), row)))
        .collect()
}
