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
    /// The receiver asked for patience until then.
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
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn take_all(queue: &mut Queue, now: Duration) -> Vec<u64> {
        std::iter::from_fn(|| queue.take(now)).map(|job| job.seq).collect()
    }

    #[test]
    fn an_alerts_later_event_waits_for_the_earlier() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut queue = Queue::default();
        queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
        queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
        queue.push("b", 3, 0, s(0), Timestamp::UNIX_EPOCH);
        assert_eq!(take_all(&mut queue, s(0)), [1, 3]);
        queue.sent(3, s(0));
        queue.failed(1, None, s(0), &mut rng);
        assert!(take_all(&mut queue, s(4)).is_empty(), "not before the schedule says so");
        assert_eq!(take_all(&mut queue, s(6)), [1]);
        queue.sent(1, s(6));
        assert_eq!(take_all(&mut queue, s(6)), [2]);
        queue.sent(2, s(6));
        assert_eq!((queue.len(), queue.wake_at()), (0, None));
    }

    #[test]
    fn a_busy_alert_takes_turns_with_quiet_ones() {
        let mut queue = Queue::default();
        for seq in 1..=100 {
            queue.push("busy", seq, 0, s(0), Timestamp::UNIX_EPOCH);
        }
        for (k, alert) in ["p", "q", "r", "t", "u"].iter().enumerate() {
            queue.push(alert, 101 + k as u64, 0, s(0), Timestamp::UNIX_EPOCH);
        }
        let mut order = Vec::new();
        for round in 1..=4 {
            for seq in take_all(&mut queue, s(round)) {
                order.push(seq);
                queue.sent(seq, s(round));
            }
        }
        let quiet_done = order.iter().position(|&seq| seq == 105).unwrap();
        assert!(quiet_done < 8, "{order:?}");
    }

    #[test]
    fn a_dead_receiver_gets_one_request_at_a_time_and_all_once_it_is_back() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut queue = Queue::default();
        for seq in 0..50 {
            queue.push(&format!("a{seq}"), seq, 0, s(0), Timestamp::UNIX_EPOCH);
        }
        let first = take_all(&mut queue, s(0));
        assert_eq!(first.len(), ABREAST);
        for seq in first {
            queue.failed(seq, None, s(0), &mut rng);
        }
        // A day without an answer. Each try is one request alone; none is given up.
        let mut tries = 0;
        let mut now = s(0);
        while now < s(24 * 3600) {
            match queue.take(now) {
                Some(job) => {
                    tries += 1;
                    assert_eq!(queue.take(now), None);
                    assert!(matches!(queue.failed(job.seq, None, now, &mut rng), Next::Retry { .. }));
                }
                None => now = queue.wake_at().unwrap().max(now + s(1)),
            }
        }
        assert!(tries > 24 * 60, "probed about once a minute, {tries} times");
        // Back: at most a minute later everything has gone out.
        let wake = queue.wake_at().unwrap();
        assert!(wake <= now + PROBE);
        let job = queue.take(wake).unwrap();
        queue.sent(job.seq, wake);
        let mut left = 49;
        while left > 0 {
            let jobs = take_all(&mut queue, wake);
            assert!(!jobs.is_empty());
            for seq in jobs {
                queue.sent(seq, wake);
                left -= 1;
            }
        }
        assert_eq!(queue.len(), 0);
    }

    #[test]
    fn only_scheduled_attempts_use_up_the_schedule() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut queue = Queue::default();
        queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
        queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
        let mut now = s(0);
        let mut attempts = 0;
        loop {
            let Some(job) = queue.take(now) else {
                now = queue.wake_at().unwrap();
                continue;
            };
            attempts += 1;
            if queue.failed(job.seq, None, now, &mut rng) == Next::Dead {
                break;
            }
        }
        assert!(now >= s(75 * 3600 + 35 * 60), "given up after {now:?}");
        assert!(attempts > 1000, "{attempts}");
        assert_eq!(
            queue.origins.keys().collect::<Vec<_>>(),
            [&2],
            "the alert's next event is not given up with it"
        );
    }

    #[test]
    fn patience_is_kept_and_holds_for_the_whole_endpoint() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut queue = Queue::default();
        queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
        let job = queue.take(s(0)).unwrap();
        queue.failed(job.seq, Some(s(600)), s(0), &mut rng);
        queue.push("b", 2, 0, s(1), Timestamp::UNIX_EPOCH);
        assert!(take_all(&mut queue, s(599)).is_empty());
        assert_eq!(queue.wake_at(), Some(s(600)));
        assert_eq!(take_all(&mut queue, s(600)).len(), 1);
    }

    #[test]
    fn a_receiver_that_is_gone_is_left_alone_until_enabled() {
        let mut queue = Queue::default();
        queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
        let job = queue.take(s(0)).unwrap();
        queue.gone(job.seq, s(0));
        queue.push("b", 2, 0, s(1), Timestamp::UNIX_EPOCH);
        assert!(take_all(&mut queue, s(1_000_000)).is_empty());
        assert_eq!(queue.wake_at(), None);
        queue.enable(s(1_000_001));
        assert_eq!(take_all(&mut queue, s(1_000_001)), [1, 2]);
    }

    #[test]
    fn a_dead_letter_that_comes_back_goes_ahead_of_what_waits() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut queue = Queue::default();
        queue.push("a", 5, 0, s(0), Timestamp::UNIX_EPOCH);
        queue.push("a", 6, 0, s(0), Timestamp::UNIX_EPOCH);
        assert_eq!(take_all(&mut queue, s(0)), [5]);
        queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
        queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
        assert_eq!(queue.len(), 3);
        queue.failed(5, None, s(0), &mut rng);
        // 5 keeps its place: it was under way already.
        assert_eq!(take_all(&mut queue, s(7)), [5]);
        queue.sent(5, s(7));
        assert_eq!(take_all(&mut queue, s(7)), [2]);
        queue.sent(2, s(7));
        assert_eq!(take_all(&mut queue, s(7)), [6]);
    }
}
