//! Converts a driver's time stamps to UTC and its 32-bit sequence numbers to frame numbers that never wrap.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use v4l::v4l_sys as c;

use super::faults::Fault;
use super::sys;

/// A time stamp older than this is rejected.
const OLDEST: Duration = Duration::from_secs(10);
/// A time stamp further ahead of its own clock than this is rejected; a little ahead is normal, because some drivers stamp by an
/// ideal frame interval.
const AHEAD: Duration = Duration::from_millis(100);

/// Both clocks at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    pub monotonic: Duration,
    pub utc: Timestamp,
}

impl Moment {
    pub fn now() -> Self {
        Self {
            monotonic: sys::monotonic(),
            utc: Timestamp::now(),
        }
    }
}

/// Whether a buffer's time stamp is on the monotonic clock.
pub fn is_monotonic(flags: u32) -> bool {
    flags & c::V4L2_BUF_FLAG_TIMESTAMP_MASK == c::V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC
}

/// When a frame was exposed, and the fault of the driver's time stamp, if any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamped {
    pub time: Timestamp,
    pub fault: Option<Fault>,
}

/// Middle of a frame's exposure. The buffer's `flags` give the clock of its `stamp`, and whether it was taken at the start or the
/// end of the exposure. An unusable stamp is replaced by the time of arrival.
pub fn exposed(flags: u32, stamp: Duration, exposure: Duration, arrival: Moment) -> Stamped {
    let half = SignedDuration::try_from(exposure / 2).unwrap_or_default();
    let shifted = |time: Timestamp, by: SignedDuration| time.checked_add(by).unwrap_or(time);
    let at_arrival = |fault| Stamped {
        time: shifted(arrival.utc, -half),
        fault: Some(fault),
    };
    if !is_monotonic(flags) {
        return at_arrival(Fault::TimestampUnknown);
    }
    let Some(age) = (arrival.monotonic + AHEAD)
        .checked_sub(stamp)
        .filter(|age| *age <= OLDEST)
    else {
        return at_arrival(Fault::TimestampImplausible);
    };
    let age = SignedDuration::try_from(age).unwrap_or_default() - SignedDuration::from_millis(AHEAD.as_millis() as i64);
    let stamped = shifted(arrival.utc, -age);
    let at_start = flags & c::V4L2_BUF_FLAG_TSTAMP_SRC_MASK == c::V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
    Stamped {
        time: shifted(stamped, if at_start { half } else { -half }),
        fault: None,
    }
}

/// Continues a driver's 32-bit sequence over wraps, restarts and reopening of the device.
#[derive(Debug, Default)]
pub struct Numbering {
    next: u64,
    last_sequence: Option<u32>,
}

/// A larger jump is a restart, not a loss.
const LARGEST_GAP: u32 = 1 << 20;

impl Numbering {
    /// The index of the frame with this sequence number, and how many were lost before it.
    pub fn number(&mut self, sequence: u32) -> (u64, u64) {
        let step = self.last_sequence.map_or(1, |last| sequence.wrapping_sub(last));
        let lost = match step {
            1..=LARGEST_GAP => u64::from(step - 1),
            _ => 0,
        };
        self.last_sequence = Some(sequence);
        let index = self.next + lost;
        self.next = index + 1;
        (index, lost)
    }

    /// The device restarts; the numbering continues.
    pub fn restart(&mut self) {
        self.last_sequence = None;
    }

    /// The index that the next frame has if none is lost.
    pub fn next(&self) -> u64 {
        self.next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MONOTONIC: u32 = c::V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    const AT_START: u32 = MONOTONIC | c::V4L2_BUF_FLAG_TSTAMP_SRC_SOE;

    fn arrival() -> Moment {
        Moment {
            monotonic: Duration::from_secs(100),
            utc: "2026-11-21T08:00:10Z".parse().unwrap(),
        }
    }

    fn at(flags: u32, stamp_ms: u64, exposure_ms: u64) -> (String, Option<Fault>) {
        let exposure = Duration::from_millis(exposure_ms);
        let s = exposed(flags, Duration::from_millis(stamp_ms), exposure, arrival());
        (s.time.to_string(), s.fault)
    }

    #[test]
    fn the_time_is_the_middle_of_the_exposure() {
        assert_eq!(at(MONOTONIC, 99_000, 0), ("2026-11-21T08:00:09Z".into(), None));
        assert_eq!(at(MONOTONIC, 99_000, 200), ("2026-11-21T08:00:08.9Z".into(), None));
        assert_eq!(at(AT_START, 99_000, 200), ("2026-11-21T08:00:09.1Z".into(), None));
    }

    #[test]
    fn an_unusable_stamp_is_replaced_by_the_arrival() {
        let late = |fault| ("2026-11-21T08:00:10Z".to_owned(), Some(fault));
        assert_eq!(at(0, 99_000, 0), late(Fault::TimestampUnknown));
        assert_eq!(at(MONOTONIC, 101_000, 0), late(Fault::TimestampImplausible));
        assert_eq!(at(MONOTONIC, 89_000, 0), late(Fault::TimestampImplausible));
        assert_eq!(at(MONOTONIC, 0, 0), late(Fault::TimestampImplausible));
    }

    #[test]
    fn the_numbering_continues_over_gaps_wraps_and_restarts() {
        let mut n = Numbering::default();
        assert_eq!(n.number(7), (0, 0));
        assert_eq!(n.number(8), (1, 0));
        assert_eq!(n.number(11), (4, 2));
        assert_eq!(n.number(3), (5, 0), "a driver that starts over");
        n.restart();
        assert_eq!(n.number(900), (6, 0), "a device opened anew");
        assert_eq!(n.number(u32::MAX), (7, 0));
        assert_eq!(n.number(0), (8, 0), "the wrap");
        assert_eq!(n.number(2), (10, 1));
        assert_eq!(n.number(2), (11, 0), "a driver that does not count");
    }
}
