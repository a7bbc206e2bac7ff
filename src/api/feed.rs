//! The latest snapshots and alert events, shared by the compute thread and all readers.
//!
//! Readers pull: each has a cursor, and nothing is queued for it. A reader that falls behind loses positions (it gets the
//! newest and the number it missed), never alert events: those that have left the ring are read back from the journal.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use axum::body::Bytes;
use jiff::Timestamp;
use serde::Serialize;
use tokio::sync::watch;

use super::history::History;
use super::picture;
use super::snapshot::Snapshot;
use crate::claim::{Claim, escape_undisplayable};
use crate::journal::Recorded;
use crate::monitor::{Alert, AlertEvent, Report};
use crate::word::word;

/// Positions kept for readers that are a moment late.
const POSITIONS_KEPT: usize = 16;
/// Alert events kept in memory; older ones come from the journal.
const EVENTS_KEPT: usize = 1024;
/// Pictures of alerts kept in memory: at some 20 kB each, 2.5 MB.
const PICTURES_KEPT: usize = 128;
/// Pictures drawn for one step.
const PICTURES_AT_ONCE: usize = 8;
/// Longer side of such a picture, in its pixels, at least.
const PICTURE_SIDE: usize = 256;
/// Claims drawn on the map at most; a log may hold 10,000 users elsewhere.
const CLAIMS_SHOWN: usize = 500;

/// A numbered snapshot, with its JSON made once for all readers.
#[derive(Debug)]
pub struct Published {
    pub seq: u64,
    /// Counts snapshots, from which the number that a reader missed follows.
    ordinal: u64,
    pub snapshot: Snapshot,
    body: OnceLock<String>,
}

/// Where a reader stands.
#[derive(Clone, Copy, Debug)]
pub struct Cursor {
    event_seq: u64,
    ordinal: u64,
}

/// The next thing for a reader, in the order of `seq`.
#[derive(Debug)]
pub enum Next {
    /// Nothing new.
    Nothing,
    Event(Arc<Recorded>),
    Positions {
        latest: Arc<Published>,
        missed: u64,
    },
    /// Events after `after`, up to and including `until`, are to be read from the journal.
    Journal {
        after: u64,
        until: u64,
    },
}

/// Shared by the compute thread, which writes, and all readers.
#[derive(Debug)]
pub struct Feed {
    ring: Mutex<Ring>,
    head: watch::Sender<u64>,
}

#[derive(Debug)]
struct Ring {
    /// The last number given out.
    last_seq: u64,
    /// The last number made known; behind `last_seq` while the journal writes.
    published: u64,
    /// The last event that is no longer in `events`.
    evicted: u64,
    snapshots: u64,
    positions: VecDeque<Arc<Published>>,
    events: VecDeque<Arc<Recorded>>,
    history: History,
    /// Pictures of the frames at which alerts were raised, by the alerts' ids, oldest first.
    pictures: VecDeque<(String, Bytes)>,
}

#[derive(Serialize)]
struct Body<'a> {
    #[serde(flatten)]
    report: &'a Report,
    claims: Vec<&'a Claim>,
    status: &'a super::snapshot::Status,
}

impl Published {
    /// Claims in and around the field of view, bounded in number.
    pub fn claims_in_view(&self) -> impl Iterator<Item = &Claim> {
        /// Of the width of what is watched, to either side.
        const AROUND: f64 = 0.25;
        let [low, high] = self.snapshot.status.bounds_m();
        let near = move |c: &&Claim| {
            [c.x_m, c.y_m].into_iter().enumerate().all(|(k, at)| {
                let room = AROUND * (high[k] - low[k]);
                (low[k] - room..=high[k] + room).contains(&at)
            })
        };
        self.snapshot.report.claims.iter().filter(near).take(CLAIMS_SHOWN)
    }

    /// JSON object of the report, the claims in view and the status.
    pub fn body(&self) -> &str {
        self.body.get_or_init(|| {
            let body = Body {
                report: &self.snapshot.report,
                claims: self.claims_in_view().collect(),
                status: &self.snapshot.status,
            };
            serde_json::to_string(&body).expect("a snapshot is plain data")
        })
    }
}

impl Feed {
    /// `after` is the last number given to an event by an earlier run (0 if none); `now_us` the time in
    /// microseconds since 1970. Starting from the larger keeps numbers increasing over restarts without
    /// writing one to disk for each frame: fewer than a million messages a second are ever published.
    pub fn new(after: u64, now_us: u64) -> Self {
        let last_seq = after.max(now_us);
        Self {
            ring: Mutex::new(Ring {
                last_seq,
                published: last_seq,
                evicted: after,
                snapshots: 0,
                positions: VecDeque::with_capacity(POSITIONS_KEPT),
                events: VecDeque::new(),
                history: History::new(),
                pictures: VecDeque::new(),
            }),
            head: watch::Sender::new(last_seq),
        }
    }

    fn ring(&self) -> MutexGuard<'_, Ring> {
        self.ring.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Numbers events of `at` (the frames' clock), for the journal to write before they are published.
    pub fn number(&self, events: Vec<AlertEvent>, at: Timestamp) -> Vec<Recorded> {
        let mut ring = self.ring();
        let numbered = |event| {
            ring.last_seq += 1;
            Recorded {
                seq: ring.last_seq,
                at,
                event,
            }
        };
        events.into_iter().map(numbered).collect()
    }

    /// Makes numbered events known, to the log too. They must come in the order of their numbers.
    pub fn publish_events(&self, events: Vec<Recorded>) {
        let Some(seq) = events.last().map(|e| e.seq) else {
            return;
        };
        events.iter().for_each(|recorded| log(&recorded.event));
        let mut ring = self.ring();
        for event in events {
            if ring.events.len() == EVENTS_KEPT
                && let Some(oldest) = ring.events.pop_front()
            {
                ring.evicted = oldest.seq;
            }
            ring.events.push_back(Arc::new(event));
        }
        ring.published = seq;
        drop(ring);
        self.head.send_replace(seq);
    }

    /// Makes a snapshot known, after the events of its report.
    pub fn publish(&self, snapshot: Snapshot) {
        let mut ring = self.ring();
        ring.last_seq += 1;
        ring.snapshots += 1;
        ring.history.record(&snapshot.report);
        let published = Arc::new(Published {
            seq: ring.last_seq,
            ordinal: ring.snapshots,
            snapshot,
            body: OnceLock::new(),
        });
        if ring.positions.len() == POSITIONS_KEPT {
            ring.positions.pop_front();
        }
        ring.positions.push_back(published);
        let seq = ring.last_seq;
        ring.published = seq;
        drop(ring);
        self.head.send_replace(seq);
    }

    /// Keeps a picture of the frame at which each alert was raised, for those that nothing is recorded of. Draws, which
    /// takes milliseconds: to be called where that delays no frame.
    pub fn illustrate(&self, raised: &[Alert], snapshot: &Snapshot) {
        let Some(frame) = &snapshot.frame else { return };
        let scale = picture::scale_for(frame, PICTURE_SIDE);
        for alert in raised.iter().take(PICTURES_AT_ONCE) {
            let marks = picture::marks_of_alert(alert, &snapshot.camera);
            let Ok(png) = picture::png(frame, &snapshot.camera, &marks, scale) else {
                continue;
            };
            let mut ring = self.ring();
            if ring.pictures.len() == PICTURES_KEPT {
                ring.pictures.pop_front();
            }
            ring.pictures.push_back((alert.id.clone(), png.into()));
        }
    }

    /// The picture that [`Feed::illustrate`] kept for an alert.
    pub(super) fn picture(&self, alert: &str) -> Option<Bytes> {
        let ring = self.ring();
        let found = ring.pictures.iter().find(|(id, _)| id == alert);
        found.map(|(_, png)| png.clone())
    }

    /// Wakes when anything is published.
    pub fn subscribe(&self) -> watch::Receiver<u64> {
        self.head.subscribe()
    }

    pub fn latest(&self) -> Option<Arc<Published>> {
        self.ring().positions.back().cloned()
    }

    /// Number of the last event published; the version of the list of alerts.
    pub fn last_event(&self) -> u64 {
        let ring = self.ring();
        ring.events.back().map_or(ring.evicted, |e| e.seq)
    }

    /// Reads the positions of the past.
    pub fn history<T>(&self, read: impl FnOnce(&History) -> T) -> T {
        read(&self.ring().history)
    }

    /// A reader that starts now, or goes on after `after`. Returns the number it goes on from, whether that
    /// is where it asked for, and the newest snapshot, which it is to be shown first.
    pub fn join(&self, after: Option<u64>) -> Joined {
        let ring = self.ring();
        let known = after.filter(|a| *a <= ring.published);
        let seq = known.unwrap_or(ring.published);
        Joined {
            seq,
            resumed: known.is_some(),
            latest: ring.positions.back().cloned(),
            cursor: Cursor {
                event_seq: seq,
                ordinal: ring.snapshots,
            },
        }
    }

    /// The next thing after `cursor`, which moves past it.
    pub fn next(&self, cursor: &mut Cursor) -> Next {
        let ring = self.ring();
        if cursor.event_seq < ring.evicted {
            let after = std::mem::replace(&mut cursor.event_seq, ring.evicted);
            return Next::Journal {
                after,
                until: ring.evicted,
            };
        }
        let first = ring.events.partition_point(|e| e.seq <= cursor.event_seq);
        let event = ring.events.get(first);
        let late = ring.positions.front().is_none_or(|p| p.ordinal > cursor.ordinal + 1);
        let positions = if late {
            ring.positions.back().filter(|p| p.ordinal > cursor.ordinal)
        } else {
            let first = ring.positions.partition_point(|p| p.ordinal <= cursor.ordinal);
            ring.positions.get(first)
        };
        match (event, positions) {
            (Some(event), positions) if positions.is_none_or(|p| event.seq < p.seq) => {
                cursor.event_seq = event.seq;
                Next::Event(event.clone())
            }
            (_, Some(latest)) => {
                let missed = latest.ordinal - cursor.ordinal - 1;
                cursor.ordinal = latest.ordinal;
                Next::Positions {
                    latest: latest.clone(),
                    missed,
                }
            }
            (_, None) => Next::Nothing,
        }
    }
}

/// What a reader starts with.
#[derive(Debug)]
pub struct Joined {
    pub seq: u64,
    pub resumed: bool,
    pub latest: Option<Arc<Published>>,
    pub cursor: Cursor,
}

/// Writes an alert's event to the log.
fn log(event: &AlertEvent) {
    let alert = &event.alert;
    tracing::info!(
        event = word(event.event),
        kind = word(alert.kind),
        severity = word(alert.severity),
        id = alert.id,
        user = alert.user.as_deref().map(escape_undisplayable).as_deref(),
        x_m = alert.x_m,
        y_m = alert.y_m,
        "alert"
    );
}
