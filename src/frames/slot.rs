//! The latest-wins slot between the capture thread and the compute thread.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::source::Next;

/// Most waiting events other than frames; beyond it the oldest is dropped.
const MOST_UNUSABLE: usize = 64;

/// An event of a source, and the recording that holds it.
#[derive(Clone, Debug)]
pub struct Captured {
    pub next: Next,
    pub file: Option<Arc<Path>>,
    /// When the source gave it.
    pub at: Instant,
}

impl Captured {
    pub fn new(next: Next, file: Option<Arc<Path>>) -> Self {
        Self {
            next,
            file,
            at: Instant::now(),
        }
    }
}

/// Holds at most one frame. A newer frame replaces it and inherits its claims; the drop is counted.
#[derive(Debug, Default)]
pub struct Slot {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Captured>,
    dropped: u64,
    closed: bool,
}

/// Result of waiting on the slot.
#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "taken apart where it is given")]
pub enum Taken {
    /// The oldest waiting event, and the number of frames dropped since the last one.
    Captured(Captured, u64),
    Nothing,
    Closed,
}

impl Slot {
    fn lock(&self) -> MutexGuard<'_, State> {
        // No code panics while it holds the lock, so a poisoned state is still consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts an event; a newer frame replaces an older one. `false` when the slot is closed.
    pub fn put(&self, mut captured: Captured) -> bool {
        let mut state = self.lock();
        if let Next::Frame(_, arrivals) = &mut captured.next {
            let older = state
                .waiting
                .iter()
                .position(|c| matches!(c.next, Next::Frame(..)))
                .and_then(|k| state.waiting.remove(k));
            if let Some(Captured {
                next: Next::Frame(_, mut inherited),
                ..
            }) = older
            {
                inherited.append(std::mem::take(arrivals));
                *arrivals = inherited;
                state.dropped += 1;
            }
        }
        state.waiting.push_back(captured);
        if state.waiting.len() > MOST_UNUSABLE {
            let oldest = state.waiting.iter().position(|c| !matches!(c.next, Next::Frame(..)));
            oldest.and_then(|k| state.waiting.remove(k));
        }
        self.changed.notify_all();
        !state.closed
    }

    /// Puts an event once the slot is empty. `false` when the slot is closed.
    pub fn put_when_empty(&self, captured: Captured) -> bool {
        let state = self.lock();
        let mut state = self
            .changed
            .wait_while(state, |s| !s.waiting.is_empty() && !s.closed)
            .unwrap_or_else(PoisonError::into_inner);
        if !state.closed {
            state.waiting.push_back(captured);
            self.changed.notify_all();
        }
        !state.closed
    }

    /// Waits up to `patience` for an event. Events put before the slot was closed are still given.
    pub fn take(&self, patience: Duration) -> Taken {
        let deadline = Instant::now() + patience;
        let mut state = self.lock();
        loop {
            if let Some(captured) = state.waiting.pop_front() {
                self.changed.notify_all();
                let dropped = std::mem::take(&mut state.dropped);
                return Taken::Captured(captured, dropped);
            }
            if state.closed {
                return Taken::Closed;
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Taken::Nothing;
            }
            state = match self.changed.wait_timeout(state, left) {
                Ok((state, _)) => state,
                Err(poisoned) => poisoned.into_inner().0,
            };
        }
    }

    /// Wakes both threads; no further event is accepted.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::thread;

    use jiff::Timestamp;

    use super::*;
    use crate::claim::{Claim, ClaimState};
    use crate::frame::{Frame, fixture};
    use crate::frames::Arrivals;

    const LONG: Duration = Duration::from_secs(20);

    fn frame(index: u64) -> Captured {
        let claim = Claim {
            time: Timestamp::UNIX_EPOCH,
            user: format!("u-{index}"),
            x_m: 0.0,
            y_m: 0.0,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        };
        Captured::new(Next::Frame(fixture::frame(index), vec![claim].into()), None)
    }

    fn unusable(index: u64) -> Captured {
        let reason = "short".to_owned();
        let time = Timestamp::UNIX_EPOCH;
        let arrivals = Arrivals::default();
        Captured::new(
            Next::Unusable {
                index,
                time,
                reason,
                arrivals,
            },
            None,
        )
    }

    fn take(slot: &Slot) -> (Next, u64) {
        match slot.take(LONG) {
            Taken::Captured(c, dropped) => (c.next, dropped),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_latest_frame_wins_and_keeps_the_claims_of_the_dropped() {
        let slot = Slot::default();
        for k in 0..3 {
            assert!(slot.put(frame(k)));
        }
        let (next, dropped) = take(&slot);
        let Next::Frame(frame, Arrivals { claims, .. }) = next else {
            panic!("{next:?}")
        };
        assert_eq!((frame.index, dropped), (2, 2));
        let users: Vec<_> = claims.iter().map(|c| c.user.as_str()).collect();
        assert_eq!(users, ["u-0", "u-1", "u-2"]);
        assert!(matches!(slot.take(Duration::ZERO), Taken::Nothing));
    }

    #[test]
    fn a_newer_frame_does_not_hide_that_one_was_unusable() {
        let slot = Slot::default();
        slot.put(frame(0));
        slot.put(unusable(1));
        slot.put(frame(2));
        assert!(matches!(take(&slot), (Next::Unusable { index: 1, .. }, 1)));
        assert!(matches!(take(&slot), (Next::Frame(Frame { index: 2, .. }, _), 0)));
    }

    #[test]
    fn what_waits_is_bounded_and_keeps_the_frame() {
        let slot = Slot::default();
        slot.put(frame(0));
        for k in 1..1000 {
            slot.put(unusable(k));
        }
        assert_eq!(slot.lock().waiting.len(), MOST_UNUSABLE);
        assert!(matches!(take(&slot), (Next::Frame(..), 0)));
    }

    #[test]
    fn a_waiting_source_loses_nothing_and_closing_wakes_it() {
        let slot = Arc::new(Slot::default());
        let writer = thread::spawn({
            let slot = slot.clone();
            move || (0..).take_while(|k| slot.put_when_empty(frame(*k))).count()
        });
        for k in 0..100 {
            assert!(matches!(take(&slot), (Next::Frame(f, _), 0) if f.index == k));
        }
        slot.close();
        assert!(writer.join().unwrap() >= 100);
        while let Taken::Captured(..) = slot.take(LONG) {}
        assert!(matches!(slot.take(LONG), Taken::Closed));
    }
}
