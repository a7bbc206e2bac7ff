//! The thread that writes batches to the SQLite file and applies retention, so that no other thread waits for the
//! disk.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender};
use std::time::Instant;

use jiff::{SignedDuration, Timestamp};

use super::outbox::Subscriptions;
use super::retention::Retention;
use super::store::{Store, Write};
use super::{Error, health};
use crate::metric;

/// Time between two retention rounds.
const RETENTION_EVERY: SignedDuration = SignedDuration::from_hours(1);

/// After a gap longer than this one retention round is skipped: the wall clock may have been set, and a clock that is wrong
/// for a while, as after a start without a network, must not make every alert old.
const CLOCK_JUMP: SignedDuration = SignedDuration::from_hours(25);

/// Writes between two retention rounds of a journal that is too large.
const WRITES_BETWEEN_ROUNDS: usize = 1_000;

/// State of the disk thread. It answers every batch.
pub(super) struct Disk {
    path: PathBuf,
    subscriptions: Subscriptions,
    retention: Retention,
    store: Option<Store>,
    opened: Option<FileId>,
    last_round: Option<Timestamp>,
    since_round: usize,
}

/// What became of a batch: the journal's size in bytes once all of it is on disk, or why none of it is.
pub(super) type Answer = Result<u64, Error>;

impl Disk {
    pub(super) fn new(path: PathBuf, subscriptions: Subscriptions, retention: Retention, store: Option<Store>) -> Self {
        Self {
            opened: FileId::of(&path),
            path,
            subscriptions,
            retention,
            store,
            last_round: None,
            since_round: WRITES_BETWEEN_ROUNDS,
        }
    }

    pub(super) fn run(mut self, batches: Receiver<Vec<Write>>, answers: Sender<Answer>) {
        for batch in batches {
            let started = Instant::now();
            let answer = self.write(&batch).map(|()| health::size(&self.path));
            metrics::histogram!(metric::JOURNAL_WRITE_SECONDS).record(started.elapsed().as_secs_f64());
            let size = answer.as_ref().copied().ok();
            if answers.send(answer).is_err() {
                return;
            }
            if let Some(size) = size {
                self.since_round += batch.len();
                self.maintain(&batch, size);
            }
        }
    }

    fn write(&mut self, batch: &[Write]) -> Result<(), Error> {
        if self.store.is_some() && FileId::of(&self.path) != self.opened {
            tracing::error!(path = %self.path.display(), "the journal was moved or deleted while in use; a new one is begun");
            self.store = None;
        }
        // Put back only on success: a fresh connection also clears faults that stick to an open file.
        let mut store = match self.store.take() {
            Some(store) => store,
            None => {
                let store = Store::open(Some(&self.path), self.subscriptions.clone())?;
                self.opened = FileId::of(&self.path);
                store
            }
        };
        store.apply(batch).map_err(|source| Error::Unusable {
            path: self.path.clone(),
            source,
        })?;
        self.store = Some(store);
        Ok(())
    }

    fn maintain(&mut self, batch: &[Write], size: u64) {
        let Some(now) = batch.iter().rev().find_map(Write::now) else {
            return;
        };
        let asked = batch.iter().any(|write| matches!(write, Write::Maintain { .. }));
        let earlier = self
            .last_round
            .or_else(|| self.store.as_ref()?.newest_recorded().ok().flatten());
        let age = now.duration_since(earlier.unwrap_or(now));
        let due = (asked || age >= RETENTION_EVERY) && age < CLOCK_JUMP;
        if self.last_round.is_none() || age >= RETENTION_EVERY || age < SignedDuration::ZERO {
            self.last_round = Some(now);
        }
        let large = self.retention.exceeded_by(size) && self.since_round >= WRITES_BETWEEN_ROUNDS;
        let Some(store) = self.store.as_mut().filter(|_| due || large) else {
            return;
        };
        self.since_round = 0;
        match store.maintain(self.retention, now) {
            Ok(removed) => {
                if removed.alerts + removed.deliveries > 0 {
                    tracing::info!(
                        alerts = removed.alerts,
                        given_up_deliveries = removed.deliveries,
                        "old alerts were removed from the journal"
                    );
                }
                if removed.oversize {
                    tracing::warn!(
                        "the journal is larger than max_mb, but all it holds is open or still to be delivered"
                    );
                }
            }
            Err(error) => tracing::warn!(%error, "old alerts could not be removed from the journal"),
        }
    }
}

/// Identifies a file, so that another of the same name is recognised.
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
