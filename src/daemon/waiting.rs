//! Frames that wait for an autopilot's poses, where these come later than the frames of their time.

use std::collections::VecDeque;
use std::time::Duration;

use jiff::Timestamp;

use crate::frames::{Captured, Next};

/// Longest wait: alerts come that much later. Longer serves slower links, of which a telemetry radio takes 0.1 to 0.3 s.
const LONGEST: Duration = Duration::from_millis(500);
/// Most frames that wait; the oldest of more is no longer waited for.
const MOST: usize = 64;

/// Events of a source in their order.
#[derive(Default)]
pub struct Waiting(VecDeque<Captured>);

impl Waiting {
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub fn push(&mut self, captured: Captured) {
        self.0.push_back(captured);
    }

    /// The oldest event, unless it is a frame that waits for the poses of its time, which `is_posed` says are there or will not come.
    pub fn take(&mut self, is_posed: impl FnOnce(Timestamp) -> bool) -> Option<Captured> {
        let is_due = match self.0.front()? {
            Captured {
                next: Next::Frame(frame, _),
                at,
                ..
            } => self.0.len() > MOST || at.elapsed() >= LONGEST || is_posed(frame.time),
            _ => true,
        };
        is_due.then(|| self.0.pop_front())?
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::fixture;
    use crate::frames::Arrivals;

    fn frame(index: u64, waits: Duration) -> Captured {
        let mut captured = Captured::new(Next::Frame(fixture::frame(index), Arrivals::default()), None);
        captured.at -= waits;
        captured
    }

    /// Indices of the frames that are due.
    fn due(waiting: &mut Waiting, is_posed: bool) -> Vec<u64> {
        let taken = std::iter::from_fn(|| waiting.take(|_| is_posed));
        let index = |captured: Captured| match captured.next {
            Next::Frame(frame, _) => frame.index,
            _ => unreachable!("only frames were put in"),
        };
        taken.map(index).collect()
    }

    #[test]
    fn frames_are_taken_in_order_when_posed_or_waited_for() {
        let mut waiting = Waiting::default();
        waiting.push(frame(0, LONGEST));
        waiting.push(frame(1, Duration::ZERO));
        waiting.push(frame(2, LONGEST));
        assert_eq!(due(&mut waiting, false), [0]);
        assert_eq!(due(&mut waiting, true), [1, 2]);
    }

    #[test]
    fn the_oldest_of_too_many_is_not_waited_for() {
        let mut waiting = Waiting::default();
        (0..MOST as u64 + 2).for_each(|index| waiting.push(frame(index, Duration::ZERO)));
        assert_eq!(due(&mut waiting, false), [0, 1]);
    }
}
