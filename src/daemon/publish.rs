//! Publishes the results of the compute thread: events to the journal, then to readers, then positions.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Notify, oneshot};

use crate::api::{Acknowledged, Feed, Snapshot};
use crate::journal::Journal;
use crate::monitor::{Alert, AlertEvent, AlertEventKind};

/// Longest time that a hanging disk delays the publication of an event.
const JOURNAL_TIMEOUT: Duration = Duration::from_secs(2);

/// Hands results from the compute thread to the publisher. It never waits: a newer snapshot replaces an older one, and events
/// are queued (they are few, and the journal bounds its backlog).
#[derive(Clone, Default)]
pub struct Outlet(Arc<Shared>);

#[derive(Default)]
struct Shared {
    pending: Mutex<Pending>,
    changed: Notify,
}

#[derive(Default)]
struct Pending {
    events: Vec<AlertEvent>,
    at: Timestamp,
    snapshot: Option<Snapshot>,
    acknowledged: Vec<(oneshot::Sender<Acknowledged>, Acknowledged)>,
    closed: bool,
}

impl Pending {
    fn is_empty(&self) -> bool {
        self.events.is_empty() && self.snapshot.is_none() && self.acknowledged.is_empty()
    }
}

impl Outlet {
    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Alert events of a step at `at` (the frames' clock), in order.
    pub fn events(&self, events: Vec<AlertEvent>, at: Timestamp) {
        if events.is_empty() {
            return;
        }
        let mut pending = self.lock();
        pending.events.extend(events);
        pending.at = at;
        drop(pending);
        self.0.changed.notify_one();
    }

    pub fn snapshot(&self, snapshot: Snapshot) {
        self.lock().snapshot = Some(snapshot);
        self.0.changed.notify_one();
    }

    /// Answers a client once the acknowledgement is on disk.
    pub fn acknowledged(&self, reply: oneshot::Sender<Acknowledged>, outcome: Acknowledged) {
        self.lock().acknowledged.push((reply, outcome));
        self.0.changed.notify_one();
    }

    /// Marks the end of the results; `publish` ends once all are published.
    pub fn close(&self) {
        self.lock().closed = true;
        self.0.changed.notify_one();
    }

    /// Publishes until the outlet is closed and empty.
    pub async fn publish(self, journal: Journal, feed: Arc<Feed>) {
        // The snapshot of the frame that raised them may come later than the events.
        let mut raised: Vec<Alert> = Vec::new();
        loop {
            let (pending, closed) = {
                let mut pending = self.lock();
                let closed = pending.closed;
                (std::mem::take(&mut *pending), closed)
            };
            if closed {
                self.lock().closed = true;
            }
            if pending.is_empty() {
                if closed {
                    return;
                }
                self.0.changed.notified().await;
                continue;
            }
            let is_raised = |event: &&AlertEvent| event.event == AlertEventKind::Raised;
            raised.extend(pending.events.iter().filter(is_raised).map(|e| e.alert.clone()));
            if !pending.events.is_empty() {
                let numbered = feed.number(pending.events, pending.at);
                if let Err(error) = journal.record_numbered(&numbered, Timestamp::now()) {
                    tracing::error!(%error, "alert events are lost to the journal");
                }
                if tokio::time::timeout(JOURNAL_TIMEOUT, journal.settled()).await.is_err() {
                    tracing::error!("the journal's disk hangs; alerts are published before they are on it");
                }
                feed.publish_events(numbered);
            }
            for (reply, outcome) in pending.acknowledged {
                // A client that has gone away needs no answer.
                let _ = reply.send(outcome);
            }
            if let Some(snapshot) = pending.snapshot {
                if !raised.is_empty() {
                    let (feed, snapshot, raised) = (feed.clone(), snapshot.clone(), std::mem::take(&mut raised));
                    tokio::task::spawn_blocking(move || feed.illustrate(&raised, &snapshot));
                }
                feed.publish(snapshot);
            }
        }
    }
}
