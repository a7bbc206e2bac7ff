use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::store::{Store, Write};
use super::{Attempt, Error, Health, Outcome, Subscription};

/// Alert events that may wait for a disk that refuses them.
pub(super) const BACKLOG: usize = 20_000;

/// Writes in one transaction: bounds how long it takes.
const BATCH: usize = 2_000;

/// How soon a disk that refused a write is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// What the writer thread, the readers and those who record share.
pub(super) struct Shared {
    pub(super) path: Option<PathBuf>,
    pub(super) subscriptions: Arc<[Subscription]>,
    queue: Mutex<Queue>,
    wake: Condvar,
    /// The journal itself when there is no path; otherwise what the disk has not taken yet.
    pub(super) overlay: Mutex<Overlay>,
    /// Sequence number of the last event that may be heard of.
    pub(super) heard: watch::Sender<u64>,
    /// How many writes are done with, on disk or in the overlay.
    pub(super) done: watch::Sender<u64>,
    pub(super) health: Mutex<Health>,
}

pub(super) struct Overlay {
    pub(super) store: Store,
    pub(super) in_use: bool,
}

struct Queue {
    writes: VecDeque<Write>,
    last_seq: u64,
    accepted: u64,
    /// Alert events here and in the writer's hands.
    events: usize,
    closing: bool,
}

/// A panic while a lock is held leaves plain data behind, never half a change.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub(super) fn new(
        path: Option<PathBuf>,
        subscriptions: Arc<[Subscription]>,
        overlay: Store,
        last_seq: u64,
        health: Health,
    ) -> Self {
        Self {
            overlay: Mutex::new(Overlay {
                store: overlay,
                in_use: path.is_none(),
            }),
            path,
            subscriptions,
            queue: Mutex::new(Queue {
                writes: VecDeque::new(),
                last_seq,
                accepted: 0,
                events: 0,
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
            metrics::counter!("oapwatch_journal_events_lost_total").increment(n as u64);
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

    pub(super) fn number_above(&self, seq: u64) {
        let mut queue = lock(&self.queue);
        queue.last_seq = queue.last_seq.max(seq);
    }

    /// Hands over any other write; gives the count of `done` at which it is through.
    pub(super) fn push(&self, write: Write) -> u64 {
        let mut queue = lock(&self.queue);
        queue.writes.push_back(write);
        queue.accepted += 1;
        self.wake.notify_one();
        queue.accepted
    }

    pub(super) fn accepted(&self) -> u64 {
        lock(&self.queue).accepted
    }

    pub(super) fn close(&self) {
        lock(&self.queue).closing = true;
        self.wake.notify_one();
    }

    fn take(&self, patience: Option<Duration>) -> (Vec<Write>, bool) {
        let queue = lock(&self.queue);
        let idle = |queue: &mut Queue| queue.writes.is_empty() && !queue.closing;
        let mut queue = match patience {
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

    fn settled(&self, events: usize) {
        lock(&self.queue).events -= events;
    }
}

/// The only one that writes. Events are heard of once they are on disk; where the disk refuses them they are
/// held in memory and heard of all the same, because filling a disk must not silence an alarm.
pub(super) struct Writer {
    shared: Arc<Shared>,
    disk: Option<Store>,
    opened: Option<FileId>,
    deferred: VecDeque<Write>,
    done: u64,
}

impl Writer {
    pub(super) fn new(shared: Arc<Shared>, disk: Option<Store>) -> Self {
        let opened = shared.path.as_deref().and_then(FileId::of);
        Self {
            shared,
            opened,
            disk,
            deferred: VecDeque::new(),
            done: 0,
        }
    }

    pub(super) fn run(mut self) {
        loop {
            let patience = (!self.deferred.is_empty()).then_some(RETRY);
            let (writes, closing) = self.shared.take(patience);
            self.write(&writes);
            self.publish(&writes);
            if closing {
                break;
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

    fn write(&mut self, writes: &[Write]) {
        let Some(path) = self.shared.path.clone() else {
            self.write_overlay(writes);
            self.shared.settled(events_in(writes));
            return;
        };
        let started = Instant::now();
        match self.write_disk(&path, writes) {
            Ok(()) => {
                metrics::histogram!("oapwatch_journal_write_seconds").record(started.elapsed().as_secs_f64());
                self.shared.settled(events_in(writes) + events_in(&self.deferred));
                if !self.deferred.is_empty() {
                    tracing::info!(
                        writes = self.deferred.len(),
                        "the journal's disk is back; all that waited is written"
                    );
                    self.deferred.clear();
                    self.clear_overlay();
                }
                lock(&self.shared.health).working(&path);
            }
            Err(error) => {
                if self.deferred.is_empty() {
                    tracing::error!(%error, "the journal cannot be written; alert events are held in memory");
                }
                metrics::counter!("oapwatch_journal_write_failures_total").increment(1);
                self.write_overlay(writes);
                for write in writes {
                    self.defer(write.clone());
                }
                // A fresh connection also recovers from faults that stick to an open file.
                self.disk = None;
                lock(&self.shared.health).failed(error.to_string(), events_in(&self.deferred));
            }
        }
    }

    fn write_disk(&mut self, path: &Path, writes: &[Write]) -> Result<(), Error> {
        let unusable = |source| Error::Unusable {
            path: path.to_owned(),
            source,
        };
        if self.disk.is_some() && FileId::of(path) != self.opened {
            tracing::error!(path = %path.display(), "the journal was moved or deleted while in use; a new one is begun");
            self.disk = None;
        }
        let mut disk = match self.disk.take() {
            Some(disk) => disk,
            None => {
                let disk = Store::open(Some(path), self.shared.subscriptions.clone())?;
                self.opened = FileId::of(path);
                disk
            }
        };
        disk.apply(self.deferred.iter().chain(writes)).map_err(unusable)?;
        self.disk = Some(disk);
        Ok(())
    }

    fn write_overlay(&self, writes: &[Write]) {
        let mut overlay = lock(&self.shared.overlay);
        overlay.in_use = true;
        if let Err(error) = overlay.store.apply(writes) {
            tracing::error!(%error, "alert events cannot even be held in memory");
            lock(&self.shared.health).lost += events_in(writes) as u64;
        }
    }

    fn clear_overlay(&self) {
        let mut overlay = lock(&self.shared.overlay);
        match Store::open(None, self.shared.subscriptions.clone()) {
            Ok(store) => {
                *overlay = Overlay { store, in_use: false };
            }
            // What it holds is on disk as well, and readers know a record twice when they see one.
            Err(error) => tracing::warn!(%error, "the journal's memory cannot be cleared"),
        }
    }

    /// Keeps a write for the disk. Only the last of a delivery's failed attempts matters.
    fn defer(&mut self, write: Write) {
        if let Write::Attempt(Attempt { seq, endpoint, .. }) = &write {
            self.deferred.retain(|earlier| {
                !matches!(earlier, Write::Attempt(Attempt { seq: s, endpoint: e, outcome: Outcome::Retry { .. }, .. })
                    if s == seq && e == endpoint)
            });
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

/// Tells a file from another that took its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct FileId {
    device: u64,
    inode: u64,
}

impl FileId {
    fn of(path: &Path) -> Option<Self> {
        use std::os::unix::fs::MetadataExt;
        let meta = std::fs::metadata(path).ok()?;
        Some(Self {
            device: meta.dev(),
            inode: meta.ino(),
        })
    }
}
