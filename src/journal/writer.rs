//! The writer thread: decides whether events are held on disk or in memory, and publishes them to readers.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::watch;

use super::outbox::Subscriptions;
use super::retention::Retention;
use super::store::{Store, Write};
use super::{Attempt, AuditEntry, AuditRecord, Error, Health, Outcome, disk};
use crate::metric;

/// Alert events that may wait for a disk that refuses them.
pub(super) const BACKLOG: usize = 20_000;

/// Rows of the audit log that may wait for a disk that refuses them: a flood of requests must not fill the memory.
pub(super) const MOST_AUDIT_ROWS: usize = 2_000;

/// Writes in one transaction: bounds how long it takes.
const BATCH: usize = 2_000;

/// How long an event waits for the disk before it is published without it: half a second is short beside the time that a
/// person takes to react, and longer than a healthy disk takes to sync.
const DISK_TIMEOUT: Duration = Duration::from_millis(500);

/// Time after which a disk that refused a write is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// What the writer thread, the readers and those who record share.
pub(super) struct Shared {
    pub(super) path: Option<PathBuf>,
    pub(super) subscriptions: Subscriptions,
    pub(super) retention: Retention,
    queue: Mutex<Queue>,
    wake: Condvar,
    /// The journal itself when there is no path; otherwise what the disk has not taken yet.
    pub(super) overlay: Mutex<Overlay>,
    /// Sequence number of the last event that is published.
    pub(super) heard: watch::Sender<u64>,
    /// How many writes are done with, on disk or in the overlay.
    pub(super) done: watch::Sender<u64>,
    pub(super) health: Mutex<Health>,
}

pub(super) struct Overlay {
    pub(super) store: Store,
    /// While it is in use: every event after this one, and what became of its deliveries, is here.
    pub(super) since: Option<u64>,
}

struct Queue {
    writes: VecDeque<Write>,
    last_seq: u64,
    accepted: u64,
    /// Alert events here and in the writer's hands.
    events: usize,
    /// Rows of the audit log, likewise.
    audit_rows: usize,
    last_audit: u64,
    closing: bool,
}

/// A panic while a lock is held leaves plain data behind, never half a change.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub(super) fn new(
        path: Option<PathBuf>,
        subscriptions: Subscriptions,
        retention: Retention,
        overlay: Overlay,
        last_seq: u64,
        health: Health,
    ) -> Self {
        Self {
            overlay: Mutex::new(overlay),
            path,
            subscriptions,
            retention,
            queue: Mutex::new(Queue {
                writes: VecDeque::new(),
                last_seq,
                accepted: 0,
                events: 0,
                audit_rows: 0,
                last_audit: 0,
                closing: false,
            }),
            wake: Condvar::new(),
            heard: watch::Sender::new(last_seq),
            done: watch::Sender::new(0),
            health: Mutex::new(health),
        }
    }

    /// Hands `n` events to the writer, numbered from `first` or, where that is taken, from the next free number;
    /// `make` gets each one's. Gives the last one's.
    pub(super) fn push_events(
        &self,
        n: usize,
        first: u64,
        mut make: impl FnMut(usize, u64) -> Write,
    ) -> Result<u64, Error> {
        let mut queue = lock(&self.queue);
        if queue.events + n > BACKLOG {
            drop(queue);
            let mut health = lock(&self.health);
            health.lost += n as u64;
            metrics::counter!(metric::JOURNAL_LOST).increment(n as u64);
            return Err(Error::BacklogFull {
                lost: health.lost,
                limit: BACKLOG,
            });
        }
        if n > 0 {
            queue.last_seq = queue.last_seq.max(first.saturating_sub(1));
        }
        for k in 0..n {
            queue.last_seq += 1;
            let write = make(k, queue.last_seq);
            queue.writes.push_back(write);
        }
        queue.events += n;
        queue.accepted += n as u64;
        self.wake.notify_one();
        Ok(queue.last_seq)
    }

    /// Hands over any other write; gives the count of `done` at which it is through.
    pub(super) fn push(&self, write: Write) -> u64 {
        let mut queue = lock(&self.queue);
        queue.writes.push_back(write);
        queue.accepted += 1;
        self.wake.notify_one();
        queue.accepted
    }

    /// Hands over a row of the audit log, numbered by its time.
    pub(super) fn push_audit(&self, entry: AuditEntry, now: Timestamp) -> bool {
        let mut queue = lock(&self.queue);
        if queue.audit_rows >= MOST_AUDIT_ROWS {
            return false;
        }
        let micros = u64::try_from(now.as_microsecond()).unwrap_or(0);
        queue.last_audit = micros.max(queue.last_audit + 1);
        let record = AuditRecord {
            id: queue.last_audit,
            at: now,
            entry,
        };
        queue.writes.push_back(Write::Audit(Arc::new(record)));
        queue.audit_rows += 1;
        queue.accepted += 1;
        self.wake.notify_one();
        true
    }

    pub(super) fn accepted(&self) -> u64 {
        lock(&self.queue).accepted
    }

    pub(super) fn close(&self) {
        lock(&self.queue).closing = true;
        self.wake.notify_one();
    }

    fn take(&self, timeout: Option<Duration>) -> (Vec<Write>, bool) {
        let queue = lock(&self.queue);
        let idle = |queue: &mut Queue| queue.writes.is_empty() && !queue.closing;
        let mut queue = match timeout {
            None => self
                .wake
                .wait_while(queue, idle)
                .unwrap_or_else(PoisonError::into_inner),
            Some(time) => {
                let woken = self.wake.wait_timeout_while(queue, time, idle);
                woken.unwrap_or_else(PoisonError::into_inner).0
            }
        };
        let n = queue.writes.len().min(BATCH);
        let writes = queue.writes.drain(..n).collect();
        (writes, queue.closing && queue.writes.is_empty())
    }

    /// The writes are on disk, or in memory where there is no disk.
    fn settled(&self, writes: &[Write]) {
        let mut queue = lock(&self.queue);
        queue.events -= events_in(writes);
        queue.audit_rows -= writes.iter().filter(|w| matches!(w, Write::Audit(_))).count();
    }
}

/// State of the writer thread. Events are published once they are on disk; where the disk refuses them or takes too long they
/// are held in memory and published all the same, because a full or hung disk must not suppress an alert.
pub(super) struct Writer {
    shared: Arc<Shared>,
    /// `None` for a journal in memory.
    disk: Option<Link>,
    /// What is not on disk yet, oldest first.
    deferred: VecDeque<Write>,
    failing: bool,
    done: u64,
}

/// The line to the disk's thread.
pub(super) struct Link {
    pub(super) batches: Sender<Vec<Write>>,
    pub(super) answers: Receiver<disk::Answer>,
    /// Writes at the head of `deferred` that the disk has not answered yet.
    pub(super) pending: usize,
    pub(super) join: JoinHandle<()>,
}

impl Writer {
    pub(super) fn new(shared: Arc<Shared>, disk: Option<Link>) -> Self {
        Self {
            shared,
            disk,
            deferred: VecDeque::new(),
            failing: false,
            done: 0,
        }
    }

    pub(super) fn run(mut self) {
        let mut behind = false;
        loop {
            let timeout = match (behind, self.deferred.is_empty()) {
                (true, _) => Some(Duration::ZERO),
                (false, false) => Some(RETRY),
                (false, true) => None,
            };
            let (writes, closing) = self.shared.take(timeout);
            behind = self.write(&writes);
            self.publish(&writes);
            if closing && !behind {
                break;
            }
        }
        self.end();
    }

    /// Waits once more for a disk that has not answered, then gives up on it.
    fn end(mut self) {
        if self.disk.as_ref().is_some_and(|link| link.pending > 0) {
            self.try_disk();
        }
        if let Some(link) = self.disk.take() {
            drop(link.batches);
            // A thread that hangs in the disk cannot be waited for.
            if link.pending == 0 && link.join.join().is_err() {
                tracing::error!("the journal's disk thread panicked");
            }
        }
        let unwritten = events_in(&self.deferred);
        if unwritten > 0 {
            tracing::error!(
                events = unwritten,
                "the journal closes with alert events that the disk never took"
            );
        }
    }

    /// Brings writes to the disk or, failing that, to memory. `true` where the disk works but has more to take.
    fn write(&mut self, writes: &[Write]) -> bool {
        if self.disk.is_none() {
            self.hold(writes);
            self.shared.settled(writes);
            return false;
        }
        for write in writes {
            self.defer(write.clone());
        }
        let progress = self.try_disk();
        if !self.deferred.is_empty() {
            self.hold(writes);
        } else if lock(&self.shared.overlay).since.is_some() {
            tracing::info!("the journal's disk is back; all that waited is written");
            self.clear_overlay();
        }
        progress && !self.deferred.is_empty()
    }

    fn try_disk(&mut self) -> bool {
        let Some(link) = &mut self.disk else { return false };
        if self.deferred.is_empty() {
            return false;
        }
        if link.pending == 0 {
            link.pending = self.deferred.len().min(BATCH);
            let batch = self.deferred.iter().take(link.pending).cloned().collect();
            if link.batches.send(batch).is_err() {
                // The disk's thread panicked; what follows fails on the answers.
                link.pending = 0;
            }
        }
        match link.answers.recv_timeout(DISK_TIMEOUT) {
            Ok(Ok(size)) => {
                let written: Vec<Write> = self.deferred.drain(..link.pending).collect();
                link.pending = 0;
                self.failing = false;
                self.shared.settled(&written);
                lock(&self.shared.health).working(size, events_in(&self.deferred));
                true
            }
            Ok(Err(error)) => {
                link.pending = 0;
                self.fail(&error);
                false
            }
            Err(RecvTimeoutError::Timeout) => {
                self.fail(&Error::Hung);
                false
            }
            Err(RecvTimeoutError::Disconnected) => {
                self.fail(&Error::Closed);
                false
            }
        }
    }

    fn fail(&mut self, error: &Error) {
        if !std::mem::replace(&mut self.failing, true) {
            tracing::error!(%error, "the journal cannot be written; alert events are held in memory");
        }
        metrics::counter!(metric::JOURNAL_FAILURES).increment(1);
        lock(&self.shared.health).failed(error.to_string(), events_in(&self.deferred));
    }

    fn hold(&self, writes: &[Write]) {
        let mut overlay = lock(&self.shared.overlay);
        overlay.since.get_or_insert(*self.shared.heard.borrow());
        let mut held = overlay.store.apply(writes);
        if self.disk.is_none()
            && let Some(now) = writes.iter().rev().find_map(Write::now)
        {
            held = held.and_then(|()| overlay.store.maintain(self.shared.retention, now).map(|_| ()));
        }
        if let Err(error) = held {
            tracing::error!(%error, "alert events cannot even be held in memory");
        }
    }

    fn clear_overlay(&self) {
        let mut overlay = lock(&self.shared.overlay);
        match Store::open(None, self.shared.subscriptions.clone()) {
            Ok(store) => *overlay = Overlay { store, since: None },
            // What it holds is on disk as well, and readers know a record when they see it twice.
            Err(error) => tracing::warn!(%error, "the journal's memory cannot be cleared"),
        }
    }

    /// Keeps a write for the disk. Only the last of a delivery's failed attempts matters.
    fn defer(&mut self, write: Write) {
        let pending = self.disk.as_ref().map_or(0, |link| link.pending);
        if let Write::Attempt(attempt) = &write {
            let overtaken = |earlier: &Write| {
                matches!(earlier, Write::Attempt(Attempt { seq, endpoint, outcome: Outcome::Retry { .. }, .. })
                    if *seq == attempt.seq && *endpoint == attempt.endpoint)
            };
            if let Some(k) = (pending..self.deferred.len()).find(|&k| overtaken(&self.deferred[k])) {
                self.deferred.remove(k);
            }
        }
        self.deferred.push_back(write);
    }

    fn publish(&mut self, writes: &[Write]) {
        let last = writes.iter().rev().find_map(|write| match write {
            Write::Event { seq, .. } => Some(*seq),
            _ => None,
        });
        if let Some(seq) = last {
            self.shared.heard.send_replace(seq);
        }
        self.done += writes.len() as u64;
        self.shared.done.send_replace(self.done);
    }
}

fn events_in<'a>(writes: impl IntoIterator<Item = &'a Write>) -> usize {
    writes.into_iter().filter(|w| matches!(w, Write::Event { .. })).count()
}
