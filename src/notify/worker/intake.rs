//! From the journal's outbox to an endpoint's queue, past its cool-down.

use std::time::Duration;

use metrics::counter;

use super::Worker;
use crate::journal::{self, Attempt, Outcome, Recorded, Waiting};
use crate::metric;
use crate::notify::cooling::Ruling;
use crate::notify::schedule;

impl Worker {
    /// Takes the deliveries of new events into the queue.
    pub(super) async fn read_new(&mut self, k: usize) -> Result<(), journal::Error> {
        let last = self.journal.last_seq();
        let lane = &self.lanes[k];
        if lane.read_to == last && last > 0 {
            return Ok(());
        }
        let (name, after, is_cooled) = (lane.endpoint.name().to_owned(), lane.read_to, !lane.cool_down.is_off());
        let rows = self
            .ask(move |journal| {
                let rows = journal.waiting(&name, after)?.into_iter();
                // What an event says matters to a cool-down only.
                let event = |seq| is_cooled.then(|| journal.event(seq)).transpose();
                rows.map(|row| Ok((event(row.seq)?.flatten(), row))).collect()
            })
            .await?;
        let rows: Vec<(Option<Recorded>, Waiting)> = rows;
        let read_to = rows.last().map_or(last, |(_, row)| row.seq.max(last));
        for (event, row) in rows {
            self.cool(k, event, row);
        }
        self.lanes[k].read_to = read_to;
        Ok(())
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
