//! Which delivery of one endpoint is made when. Pure: times are [`Duration`]s on a clock that never jumps.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use rand::Rng;

use super::schedule;

/// Requests to one endpoint at a time; one while it fails.
const ABREAST: usize = 4;

/// A failing endpoint is tried this often, beside the schedule, so that all that waits goes out soon after it
/// is back.
const PROBE: Duration = Duration::from_secs(60);

/// An attempt to be made now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Job {
    pub(super) seq: u64,
}

/// What an attempt means for its delivery.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    Sent,
    /// Tried again once the wait is over.
    Retry {
        step: u32,
        wait: Duration,
    },
    /// The schedule is used up.
    Dead,
}

#[derive(Debug)]
struct Item {
    seq: u64,
    /// Steps of the schedule that are used up.
    step: u32,
    due: Duration,
    /// Made ahead of the schedule: a failure then uses up no step.
    early: bool,
}

/// One alert's deliveries in order; only the first may be under way.
#[derive(Debug, Default)]
struct Line {
    items: VecDeque<Item>,
    /// Key in `ready`; `None` while the first is under way.
    key: Option<(Duration, u64)>,
}

/// Where a delivery comes from.
#[derive(Debug)]
struct Origin {
    alert: Arc<str>,
    recorded: Timestamp,
}

#[derive(Debug, Default)]
pub(super) struct Queue {
    lines: HashMap<Arc<str>, Line>,
    /// First items by the time they may go.
    ready: BTreeSet<(Duration, u64)>,
    /// Every delivery, in the order of the events.
    origins: BTreeMap<u64, Origin>,
    under_way: usize,
    /// When the next probe may go; `None` while the endpoint works.
    probe_at: Option<Duration>,
    /// Until then the receiver asked for no request (`Retry-After`).
    not_before: Duration,
    disabled: bool,
}

impl Queue {
    /// Adds a delivery; one that is known already is left alone. `due` may lie in the past.
    pub(super) fn push(&mut self, alert: &str, seq: u64, step: u32, due: Duration, recorded: Timestamp) {
        if self.origins.contains_key(&seq) {
            return;
        }
        let alert: Arc<str> = match self.lines.get_key_value(alert) {
            Some((alert, _)) => alert.clone(),
            None => alert.into(),
        };
        let origin = Origin {
            alert: alert.clone(),
            recorded,
        };
        self.origins.insert(seq, origin);
        let line = self.lines.entry(alert.clone()).or_default();
        let busy = usize::from(!line.items.is_empty() && line.key.is_none());
        let at = busy + line.items.iter().skip(busy).take_while(|item| item.seq < seq).count();
        let item = Item {
            seq,
            step,
            due,
            early: false,
        };
        line.items.insert(at, item);
        if at == 0 {
            self.ready_first(&alert, due);
        }
    }

    /// Puts an alert's first delivery at its place among those of the other alerts.
    fn ready_first(&mut self, alert: &str, at: Duration) {
        let Some(line) = self.lines.get_mut(alert) else { return };
        if let Some(key) = line.key.take() {
            self.ready.remove(&key);
        }
        if let Some(first) = line.items.front() {
            let key = (at, first.seq);
            line.key = Some(key);
            self.ready.insert(key);
        }
    }

    /// The attempt to make at `now`, if any.
    pub(super) fn take(&mut self, now: Duration) -> Option<Job> {
        if self.disabled || now < self.not_before {
            return None;
        }
        let abreast = if self.probe_at.is_some() { 1 } else { ABREAST };
        if self.under_way >= abreast {
            return None;
        }
        let &(at, seq) = self.ready.first()?;
        let probe = at > now;
        if probe && self.probe_at.is_none_or(|probe_at| now < probe_at) {
            return None;
        }
        self.ready.remove(&(at, seq));
        let alert = self.alert_of(seq);
        let line = self.line(&alert);
        line.key = None;
        line.items[0].early |= probe;
        self.under_way += 1;
        Some(Job { seq })
    }

    /// Notes a delivery; the alert's next may go.
    pub(super) fn sent(&mut self, seq: u64, now: Duration) -> Next {
        self.under_way -= 1;
        let was_failing = self.probe_at.take().is_some();
        self.drop_first(seq, now);
        if was_failing {
            self.bring_forward(now);
        }
        Next::Sent
    }

    /// Notes a failed attempt. `retry_after` is what the receiver asked for.
    pub(super) fn failed(
        &mut self,
        seq: u64,
        retry_after: Option<Duration>,
        now: Duration,
        rng: &mut impl Rng,
    ) -> Next {
        self.under_way -= 1;
        let patience = retry_after.unwrap_or_default();
        self.not_before = self.not_before.max(now + patience);
        self.probe_at = Some(now + PROBE.max(patience));
        let alert = self.alert_of(seq);
        let line = self.line(&alert);
        let item = &mut line.items[0];
        if !std::mem::take(&mut item.early) {
            item.step += 1;
            match schedule::wait(item.step, rng) {
                Some(wait) => item.due = now + wait.max(patience),
                None => {
                    self.drop_first(seq, now);
                    return Next::Dead;
                }
            }
        }
        let (step, due) = (item.step, item.due);
        self.ready_first(&alert, due);
        Next::Retry {
            step,
            wait: due.saturating_sub(now),
        }
    }

    /// Notes that the receiver wants no more: everything stays where it is until [`Queue::enable`].
    pub(super) fn gone(&mut self, seq: u64, now: Duration) -> Next {
        self.under_way -= 1;
        self.disabled = true;
        let alert = self.alert_of(seq);
        let line = self.line(&alert);
        let step = line.items[0].step;
        self.ready_first(&alert, now);
        Next::Retry {
            step,
            wait: Duration::ZERO,
        }
    }

    /// Forgets a delivery whose event is no longer there.
    pub(super) fn expired(&mut self, seq: u64, now: Duration) {
        self.under_way -= 1;
        self.drop_first(seq, now);
    }

    pub(super) fn disable(&mut self) {
        self.disabled = true;
    }

    pub(super) fn enable(&mut self, now: Duration) {
        self.disabled = false;
        self.not_before = now;
        self.bring_forward(now);
    }

    /// Has the endpoint tried at once, and everything else only when that went well: the state of the receiver
    /// is not known after a start.
    pub(super) fn probe_first(&mut self, now: Duration) {
        self.probe_at = Some(now);
    }

    /// Lets all that waits for its schedule go now.
    fn bring_forward(&mut self, now: Duration) {
        let late: Vec<(Duration, u64)> = self.ready.iter().filter(|(at, _)| *at > now).copied().collect();
        for (_, seq) in late {
            let alert = self.alert_of(seq);
            if let Some(first) = self.lines.get_mut(&alert).and_then(|line| line.items.front_mut()) {
                first.early = true;
            }
            self.ready_first(&alert, now);
        }
    }

    fn drop_first(&mut self, seq: u64, now: Duration) {
        let alert = self.alert_of(seq);
        self.origins.remove(&seq);
        let line = self.line(&alert);
        line.items.pop_front();
        match line.items.front() {
            // Behind the other alerts that are due: a busy alert takes turns with quiet ones.
            Some(first) => {
                let at = first.due.max(now);
                self.ready_first(&alert, at);
            }
            None => {
                self.lines.remove(&alert);
            }
        }
    }

    fn alert_of(&self, seq: u64) -> Arc<str> {
        self.origins
            .get(&seq)
            .expect("a delivery keeps its origin until it leaves the queue")
            .alert
            .clone()
    }

    fn line(&mut self, alert: &str) -> &mut Line {
        self.lines
            .get_mut(alert)
            .expect("an alert keeps its line until its last delivery leaves")
    }

    /// When [`Queue::take`] is worth asking again, attempts under way aside.
    pub(super) fn wake_at(&self) -> Option<Duration> {
        let &(at, _) = self.ready.first()?;
        let probe_at = self.probe_at.unwrap_or(Duration::MAX);
        (!self.disabled).then(|| at.min(probe_at).max(self.not_before))
    }

    pub(super) fn len(&self) -> usize {
        self.origins.len()
    }

    /// When the oldest event that waits was recorded.
    pub(super) fn oldest(&self) -> Option<Timestamp> {
        self.origins.values().next().map(|origin| origin.recorded)
    }

    pub(super) fn is_failing(&self) -> bool {
        self.probe_at.is_some()
    }

    pub(super) fn is_disabled(&self) -> bool {
        self.disabled
    }
}

#[cfg(test)]
mod tests;
