//! The worker's wall clock and monotonic clock; tests make both run fast.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::time::Instant;

/// The worker's two clocks: the wall's, which may jump, for what receivers and people read, and a steady one
/// for all waiting. A test makes both run fast.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    started: Instant,
    /// Where the wall clock began and how many times faster than the real one it runs; `None` is the real one.
    fast: Option<(Timestamp, f64)>,
}

impl Clock {
    pub fn wall() -> Self {
        Self {
            started: Instant::now(),
            fast: None,
        }
    }

    pub fn fast(start: Timestamp, speed: f64) -> Self {
        Self {
            started: Instant::now(),
            fast: Some((start, speed)),
        }
    }

    pub fn now(&self) -> Timestamp {
        match self.fast {
            None => Timestamp::now(),
            Some((start, _)) => start
                .saturating_add(SignedDuration::try_from(self.uptime()).unwrap_or(SignedDuration::MAX))
                .unwrap_or(Timestamp::MAX),
        }
    }

    pub(super) fn uptime(&self) -> Duration {
        let real = self.started.elapsed();
        match self.fast {
            None => real,
            Some((_, speed)) => real.mul_f64(speed),
        }
    }

    pub(super) async fn sleep_until(&self, uptime: Duration) {
        let wait = uptime.saturating_sub(self.uptime());
        tokio::time::sleep(match self.fast {
            None => wait,
            Some((_, speed)) => wait.div_f64(speed),
        })
        .await;
    }
}
