//! Layer 4: alerts and webhook deliveries on disk before they are published.
//!
//! One thread writes ([`Journal::record`] hands over the events and returns at once, so that a slow disk never
//! delays a frame); any thread reads, over its own read-only connection. SQLite in WAL mode with
//! `synchronous=FULL`: what [`Follower`] gives out survives a kill -9 and a power cut. While the disk refuses
//! writes or hangs, events wait in memory, in order, are published all the same, and [`Health`] reports it.

mod audit;
mod config;
#[allow(clippy::disallowed_methods, reason = "a hanging disk is known by the time it takes")]
mod disk;
mod error;
mod follow;
mod health;
mod origin;
mod outbox;
mod query;
mod reading;
mod retention;
mod schema;
mod store;
mod writer;

use std::fs::{File, OpenOptions, TryLockError};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::{Arc, Mutex, mpsc};
use std::thread::JoinHandle;

use jiff::Timestamp;
use tokio::sync::watch;

use crate::monitor::{Alert, AlertEvent};
use disk::Disk;
use outbox::Subscriptions;
use retention::Retention;
use store::{Store, Write};
use writer::{Link, Overlay, Shared, Writer, lock};

pub use audit::{AuditAction, AuditEntry, AuditRecord};
pub use config::{Config, ConfigError};
pub use error::Error;
pub use follow::Follower;
pub use health::Health;
pub use origin::Origin;
pub use outbox::{Attempt, DeadLetter, EndpointRecord, Outcome, Subscription, Waiting};
pub use query::{Cursor, Filter, Recorded};

/// A page of `GET /v1/alerts`.
#[derive(Clone, Debug, Default)]
pub struct Page {
    pub alerts: Vec<Alert>,
    /// Where the next page begins; `None` on the last.
    pub next: Option<Cursor>,
}

/// A handle on the journal; clones share it. Dropping the last one writes what is queued and closes the file.
#[derive(Clone)]
pub struct Journal {
    shared: Arc<Shared>,
    readers: Arc<Mutex<Vec<Store>>>,
    id: Arc<str>,
    _thread: Arc<Thread>,
}

/// Ends the writer thread with the last handle, then releases the lock.
struct Thread {
    shared: Arc<Shared>,
    join: Option<JoinHandle<()>>,
    _claim: Option<File>,
}

impl Drop for Thread {
    fn drop(&mut self) {
        self.shared.close();
        if let Some(join) = self.join.take()
            && join.join().is_err()
        {
            tracing::error!("the journal's writer panicked");
        }
    }
}

/// Idle readers that are kept open.
const READERS: usize = 4;

/// Events that one alert's history shows at most.
const HISTORY: usize = 1_000;

impl Journal {
    /// Opens or creates the journal. A full or read-only disk is no error here: the journal starts in memory and
    /// writes once it can. A file that is not ours, or newer than us, is.
    pub fn open(config: &Config, subscriptions: Vec<Subscription>) -> Result<Self, Error> {
        let subscriptions: Subscriptions = Arc::new(arc_swap::ArcSwap::from_pointee(subscriptions));
        let overlay = Store::open(None, subscriptions.clone())?;
        let mut health = Health {
            path: config.path.clone(),
            writable: true,
            ..Health::default()
        };
        let mut claim = None;
        let mut disk = None;
        let mut identity = overlay.identity()?;
        if let Some(path) = &config.path {
            claim = claim_file(path)?;
            match Store::open(Some(path), subscriptions.clone()) {
                Ok(store) => {
                    identity = store.identity()?;
                    disk = Some(store);
                    health.working(health::size(path), 0);
                }
                Err(Error::Unusable { source, path }) if error::is_passing(&source) || is_read_only(&path) => {
                    tracing::error!(path = %path.display(), error = %source, "the journal cannot be written; alerts are held in memory");
                    if let Ok(known) = Store::open_readable(&path).and_then(|store| store.identity()) {
                        identity = known;
                    }
                    health.failed(source.to_string(), 0);
                }
                Err(error) => return Err(error),
            }
        }
        let (id, last_seq) = identity;
        let overlay = Overlay {
            store: overlay,
            since: disk.is_none().then_some(last_seq),
        };
        let retention = Retention::new(config);
        let shared = Arc::new(Shared::new(
            config.path.clone(),
            subscriptions.clone(),
            retention,
            overlay,
            last_seq,
            health,
        ));
        let link = match &config.path {
            Some(path) => {
                let disk = Disk::new(path.clone(), subscriptions, retention, disk);
                let (batches, work) = mpsc::channel();
                let (reply, answers) = mpsc::channel();
                Some(Link {
                    batches,
                    answers,
                    pending: 0,
                    join: thread("journal-disk", config, move || disk.run(work, reply))?,
                })
            }
            None => None,
        };
        let writer = Writer::new(shared.clone(), link);
        let join = thread("journal", config, move || writer.run())?;
        Ok(Self {
            readers: Arc::default(),
            id: id.into(),
            _thread: Arc::new(Thread {
                shared: shared.clone(),
                join: Some(join),
                _claim: claim,
            }),
            shared,
        })
    }

    /// Hands alert events to the writer, which puts them and their webhook deliveries on disk in one transaction.
    /// `at` is the frames' clock, `now` the wall's. Never waits for the disk. Gives the last sequence number; an
    /// error means the backlog is full and these events are lost to the journal.
    pub fn record(&self, events: &[AlertEvent], at: Timestamp, now: Timestamp) -> Result<u64, Error> {
        self.shared.push_events(events.len(), 0, |k, seq| Write::Event {
            seq,
            event: Arc::new(events[k].clone()),
            at,
            now,
            origin: None,
        })
    }

    /// As [`Journal::record`], for events that have their numbers: consecutive and above [`Journal::last_seq`].
    pub fn record_numbered(&self, events: &[Recorded], now: Timestamp) -> Result<u64, Error> {
        self.record_from(events, |_| None, now)
    }

    /// As [`Journal::record_numbered`], for events that another journal had first: with each, in the same transaction, how far
    /// its source has been taken over ([`Journal::origins`]).
    pub fn record_from(
        &self,
        events: &[Recorded],
        origin: impl Fn(usize) -> Option<Origin>,
        now: Timestamp,
    ) -> Result<u64, Error> {
        let first = events.first().map_or(0, |e| e.seq);
        self.shared.push_events(events.len(), first, |k, seq| Write::Event {
            seq,
            event: Arc::new(events[k].event.clone()),
            at: events[k].at,
            now,
            origin: origin(k),
        })
    }

    /// Waits until all that was handed over so far is on disk or, where the disk refuses it, in memory.
    pub async fn settled(&self) {
        self.until(self.shared.accepted()).await;
    }

    async fn until(&self, done: u64) {
        let mut watch = self.shared.done.subscribe();
        // An error would mean that the sender, which `shared` holds, is gone.
        let _ = watch.wait_for(|&n| n >= done).await;
    }

    /// Sequence number of the last event that is published.
    pub fn last_seq(&self) -> u64 {
        *self.shared.heard.borrow()
    }

    /// [`Journal::last_seq`] as it grows.
    pub fn heard(&self) -> watch::Receiver<u64> {
        self.shared.heard.subscribe()
    }

    /// Writes outbox rows for these endpoints from the next event on, and no more for those of `before`. Rows stay.
    pub fn resubscribe(&self, before: &[String], subscriptions: &[Subscription]) {
        self.shared.subscriptions.rcu(|now| {
            let kept = now.iter().filter(|s| !before.contains(&s.endpoint));
            kept.chain(subscriptions).cloned().collect::<Vec<_>>()
        });
    }

    /// The journal's own random name, for ids that stay unique over journals.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The id of an event, which receivers recognise a repeat by.
    pub fn event_id(&self, seq: u64) -> String {
        format!("msg_{}_{seq}", self.id)
    }

    pub fn health(&self) -> Health {
        lock(&self.shared.health).clone()
    }

    /// Notes how a delivery attempt ended.
    pub fn attempted(&self, attempt: Attempt) {
        self.shared.push(Write::Attempt(attempt));
    }

    pub fn disable(&self, endpoint: &str, at: Timestamp, reason: String) {
        self.shared.push(Write::Disable {
            endpoint: endpoint.to_owned(),
            at,
            reason,
        });
    }

    pub async fn enable(&self, endpoint: &str) {
        let endpoint = endpoint.to_owned();
        let done = self.shared.push(Write::Enable { endpoint });
        self.until(done).await;
    }

    /// Puts one dead letter, or all of an endpoint's, back into the outbox.
    pub async fn replay(&self, endpoint: &str, seq: Option<u64>, at: Timestamp) {
        let endpoint = endpoint.to_owned();
        let done = self.shared.push(Write::Replay { endpoint, seq, at });
        self.until(done).await;
    }

    /// Adds a row to the audit log; `now` is the wall clock. Never waits for the disk. Gives whether there was room: while the
    /// disk refuses writes, only 2,000 rows wait for it in memory.
    pub fn audit(&self, entry: AuditEntry, now: Timestamp) -> bool {
        self.shared.push_audit(entry, now)
    }

    /// Keeps what an operator has set over restarts, or forgets it without a `body`. Never waits for the disk.
    pub fn keep(&self, kind: &'static str, id: &str, body: Option<String>) {
        let id = id.to_owned();
        self.shared.push(Write::Keep { kind, id, body });
    }

    /// Removes what is older than `keep_days` or beyond `max_mb`. Where the last event or round is more than a day
    /// before `now`, only the next call does: the clock may be wrong.
    pub fn maintain(&self, now: Timestamp) {
        self.shared.push(Write::Maintain { now });
    }
}

fn thread(name: &str, config: &Config, run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, Error> {
    let builder = std::thread::Builder::new().name(name.to_owned());
    builder.spawn(run).map_err(|source| Error::Io {
        path: config.path.clone().unwrap_or_default(),
        source,
    })
}

/// Locks the journal for this process. On a disk where no lock file can be made, no other process can write either.
fn claim_file(path: &Path) -> Result<Option<File>, Error> {
    let name = schema::beside(path, ".lock");
    let mut options = OpenOptions::new();
    options.create(true).truncate(false).write(true).mode(schema::PRIVATE);
    let Ok(file) = options.open(name) else {
        return Ok(None);
    };
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Err(Error::InUse { path: path.to_owned() }),
        Err(TryLockError::Error(error)) => {
            tracing::warn!(%error, "the journal's file system has no locks; a second oapwatch would not be noticed");
            Ok(None)
        }
    }
}

fn is_read_only(path: &Path) -> bool {
    let opened = OpenOptions::new().append(true).open(path);
    opened.is_err_and(|e| e.kind() == std::io::ErrorKind::ReadOnlyFilesystem)
}
