//! `/v1/stream` (WebSocket) and `/v1/events` (server-sent events): a snapshot, then changes.

use std::collections::VecDeque;
use std::sync::Arc;

use serde::Serialize;
use tokio::sync::watch;

use super::alerts;
use super::feed::{Cursor, Joined, Next};
use super::state::State;
use crate::journal::{Journal, Recorded};
use crate::metric;
use crate::monitor::Alert;

/// Events read from the journal at a time.
const JOURNAL_BATCH: usize = 256;
/// Standing alerts in the first message.
const ALERTS_SHOWN: usize = 500;

/// A message of the stream. Every message has a `seq`, larger than the one before.
///
/// `snapshot` comes first; its `seq` is where the connection goes on from. `positions` are lost by a reader that is
/// too slow: `missed` counts how many since the last. `alert` is never lost; after a reconnect with `?after=SEQ` all
/// alert events numbered above SEQ come again, also those of an earlier run of the daemon.
#[derive(Debug, utoipa::ToSchema)]
#[allow(
    dead_code,
    reason = "describes messages that are put together from parts made once for all readers"
)]
pub struct Message {
    /// "snapshot", "positions" or "alert".
    r#type: String,
    seq: u64,
}

/// A message ready to be sent.
pub struct Outgoing {
    pub seq: u64,
    pub kind: &'static str,
    pub text: String,
}

/// One reader's place in the feed.
pub struct Reader {
    state: State,
    cursor: Cursor,
    first: Option<Outgoing>,
    /// Events read back from the journal, to be sent before anything newer.
    backlog: VecDeque<Arc<Recorded>>,
    /// How far the journal is still to be read.
    owed: Option<(u64, u64)>,
    head: watch::Receiver<u64>,
}

#[derive(Serialize)]
struct AlertMessage<'a> {
    r#type: &'static str,
    #[serde(flatten)]
    event: &'a Recorded,
}

#[derive(Serialize)]
struct Greeting {
    r#type: &'static str,
    seq: u64,
    resumed: bool,
    alerts: Vec<Alert>,
}

/// Puts the members of JSON object `body` behind those of JSON object `head`.
fn join_objects(mut head: String, body: &str) -> String {
    head.truncate(head.len() - 1);
    head.push(',');
    head.push_str(&body[1..]);
    head
}

impl Reader {
    /// Starts now, or goes on after the event numbered `after`.
    pub async fn join(state: State, after: Option<u64>) -> Self {
        let head = state.feed.subscribe();
        let Joined {
            seq,
            resumed,
            latest,
            cursor,
        } = state.feed.join(after);
        let read = move |journal: &Journal| {
            let mut all = journal.open_alerts()?;
            all.reverse();
            all.truncate(ALERTS_SHOWN);
            Ok(all)
        };
        let greeting = Greeting {
            r#type: "snapshot",
            seq,
            resumed,
            alerts: alerts::read(&state, read).await.unwrap_or_default(),
        };
        let greeting = serde_json::to_string(&greeting).expect("a greeting is plain data");
        let text = match latest {
            Some(latest) => join_objects(greeting, latest.body()),
            None => greeting,
        };
        Self {
            state,
            cursor,
            first: Some(Outgoing {
                seq,
                kind: "snapshot",
                text,
            }),
            backlog: VecDeque::new(),
            owed: None,
            head,
        }
    }

    /// The next message; waits for it. Dropping the future loses nothing: state moves on only right before a return.
    pub async fn next(&mut self) -> Outgoing {
        loop {
            if let Some(first) = self.first.take() {
                return first;
            }
            if let Some(event) = self.backlog.pop_front() {
                return alert_message(&event);
            }
            if let Some((after, until)) = self.owed {
                self.read_back(after, until).await;
                continue;
            }
            self.head.mark_unchanged();
            match self.state.feed.next(&mut self.cursor) {
                Next::Event(event) => return alert_message(&event),
                Next::Positions { latest, missed } => {
                    if missed > 0 {
                        metrics::counter!(metric::STREAM_POSITIONS_MISSED).increment(missed);
                    }
                    let head = format!(r#"{{"type":"positions","seq":{},"missed":{missed}}}"#, latest.seq);
                    return Outgoing {
                        seq: latest.seq,
                        kind: "positions",
                        text: join_objects(head, latest.body()),
                    };
                }
                Next::Journal { after, until } => self.owed = Some((after, until)),
                Next::Nothing => {
                    // The sender lives in the feed that `self.state` holds.
                    let _ = self.head.changed().await;
                }
            }
        }
    }

    async fn read_back(&mut self, after: u64, until: u64) {
        let events = alerts::read(&self.state, move |journal| journal.events_after(after, JOURNAL_BATCH)).await;
        match events {
            Ok(events) => {
                let last = events.last().map_or(until, |e| e.seq);
                self.owed = (last < until && events.len() == JOURNAL_BATCH).then_some((last, until));
                let owed = events.into_iter().filter(|e| e.seq <= until);
                self.backlog.extend(owed.map(Arc::new));
            }
            Err(_) => tokio::time::sleep(std::time::Duration::from_secs(1)).await,
        }
    }
}

fn alert_message(event: &Arc<Recorded>) -> Outgoing {
    let message = AlertMessage { r#type: "alert", event };
    Outgoing {
        seq: event.seq,
        kind: "alert",
        text: serde_json::to_string(&message).expect("an alert is plain data"),
    }
}
