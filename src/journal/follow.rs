//! An in-order reader of alert events as they become durable.

use tokio::sync::watch;

use super::{Error, Journal, Recorded};

/// Events read at once.
const PAGE: usize = 256;

/// Reads alert events in order as they become durable. However slow, it misses none: what it has not taken yet
/// is in the journal.
pub struct Follower {
    journal: Journal,
    heard: watch::Receiver<u64>,
    after: u64,
}

impl Journal {
    /// Alert events after the one numbered `after`, as they become durable; none is left out however slowly they are taken.
    pub fn follow(&self, after: u64) -> Follower {
        Follower {
            journal: self.clone(),
            heard: self.heard(),
            after,
        }
    }
}

impl Follower {
    /// Waits for the next events; at least one, in order. May be dropped while it waits without losing any.
    pub async fn next(&mut self) -> Result<Vec<Recorded>, Error> {
        loop {
            let after = self.after;
            // An error would mean that the sender, which the journal holds, is gone.
            let _ = self.heard.wait_for(|&last| last > after).await;
            let last = *self.heard.borrow_and_update();
            let events = self.journal.events_after(after, PAGE)?;
            match events.last() {
                Some(event) => {
                    self.after = event.seq;
                    return Ok(events);
                }
                // All of them were removed by retention, or cannot be read.
                None => self.after = last,
            }
        }
    }
}
