//! Faults of a device: each is counted; the log gets the first of a kind and then fewer and fewer.

use std::time::{Duration, Instant};

use crate::metric;

/// A fault of a device; the label `fault` of `oapwatch_source_faults_total`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Frames were lost between two that arrived.
    SequenceGap,
    /// The driver flags the frame as corrupt.
    ErrorFlag,
    ShortFrame,
    /// A JPEG image that is truncated, damaged or of another size.
    DamagedImage,
    /// A frame from before the stream was started, or from before the settings took effect.
    StaleFrame,
    /// A time stamp on an unknown clock; the time of arrival is used.
    TimestampUnknown,
    /// A time stamp in the future or long past.
    TimestampImplausible,
    TimestampBackwards,
    /// No frame for longer than `stall_s`; the device is reopened.
    Stalled,
    /// A signal interrupted a wait.
    Interrupted,
    /// EACCES: after a replug, until udev has set the group of the node.
    Permission,
    /// ENODEV, ENXIO or ENOENT: the device is gone.
    Gone,
    /// EBUSY: another process streams from it.
    Busy,
    /// EIO and every other error.
    Io,
    /// The format of the driver is not supported.
    FormatRefused,
    /// The format differs from the one before the device was reopened.
    FormatChanged,
    ControlRefused,
}

impl Fault {
    const ALL: [Self; 17] = [
        Self::SequenceGap,
        Self::ErrorFlag,
        Self::ShortFrame,
        Self::DamagedImage,
        Self::StaleFrame,
        Self::TimestampUnknown,
        Self::TimestampImplausible,
        Self::TimestampBackwards,
        Self::Stalled,
        Self::Interrupted,
        Self::Permission,
        Self::Gone,
        Self::Busy,
        Self::Io,
        Self::FormatRefused,
        Self::FormatChanged,
        Self::ControlRefused,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::SequenceGap => "sequence_gap",
            Self::ErrorFlag => "error_flag",
            Self::ShortFrame => "short_frame",
            Self::DamagedImage => "damaged_image",
            Self::StaleFrame => "stale_frame",
            Self::TimestampUnknown => "timestamp_unknown",
            Self::TimestampImplausible => "timestamp_implausible",
            Self::TimestampBackwards => "timestamp_backwards",
            Self::Stalled => "stalled",
            Self::Interrupted => "interrupted",
            Self::Permission => "permission",
            Self::Gone => "gone",
            Self::Busy => "busy",
            Self::Io => "io",
            Self::FormatRefused => "format_refused",
            Self::FormatChanged => "format_changed",
            Self::ControlRefused => "control_refused",
        }
    }

    pub fn of(error: &std::io::Error) -> Self {
        match error.raw_os_error() {
            Some(libc::EACCES | libc::EPERM) => Self::Permission,
            Some(libc::ENODEV | libc::ENXIO | libc::ENOENT) => Self::Gone,
            Some(libc::EBUSY) => Self::Busy,
            Some(libc::EINTR) => Self::Interrupted,
            _ => Self::Io,
        }
    }
}

/// Pause after the first log line of a kind; it grows with each line.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(3600);

#[derive(Clone, Copy, Debug)]
struct Tally {
    unlogged: u64,
    pause: Duration,
    last_logged: Option<Instant>,
}

/// Counts faults and decides which are worth a log line.
#[derive(Debug)]
pub struct Faults {
    device: String,
    tallies: [Tally; Fault::ALL.len()],
}

impl Faults {
    pub fn new(device: String) -> Self {
        for fault in Fault::ALL {
            metrics::counter!(metric::SOURCE_FAULTS, "fault" => fault.name()).increment(0);
        }
        let tally = Tally {
            unlogged: 0,
            pause: FIRST_PAUSE,
            last_logged: None,
        };
        Self {
            device,
            tallies: [tally; Fault::ALL.len()],
        }
    }

    pub fn count(&mut self, fault: Fault, details: impl std::fmt::Display) {
        metrics::counter!(metric::SOURCE_FAULTS, "fault" => fault.name()).increment(1);
        if let Some(before) = self.tallies[fault as usize].count(Instant::now()) {
            tracing::warn!(
                device = self.device,
                fault = fault.name(),
                unlogged = before,
                "{details}"
            );
        }
    }
}

impl Tally {
    /// When this fault is to be logged: the number that were not logged before it.
    fn count(&mut self, now: Instant) -> Option<u64> {
        let since = self.last_logged.map(|at| now.saturating_duration_since(at));
        match since {
            Some(quiet) if quiet < self.pause => {
                self.unlogged += 1;
                return None;
            }
            // A kind that has not occurred for long is logged at once again.
            Some(quiet) if quiet > LONGEST_PAUSE => self.pause = FIRST_PAUSE,
            Some(_) => self.pause = (self.pause * 4).min(LONGEST_PAUSE),
            None => {}
        }
        self.last_logged = Some(now);
        Some(std::mem::take(&mut self.unlogged))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fault_has_its_own_tally() {
        for (k, fault) in Fault::ALL.into_iter().enumerate() {
            assert_eq!(fault as usize, k);
        }
    }

    #[test]
    fn a_storm_of_faults_makes_few_log_lines() {
        let mut tally = Tally {
            unlogged: 0,
            pause: FIRST_PAUSE,
            last_logged: None,
        };
        let begin = Instant::now();
        // Twenty a second for a day.
        let storm = (0..20 * 86_400u32).map(|k| begin + Duration::from_millis(50) * k);
        let logged: Vec<u64> = storm.filter_map(|now| tally.count(now)).collect();
        assert_eq!(logged[0], 0);
        // Pauses of 1, 4, 16, … s reach an hour after 1.5 hours; then one an hour.
        assert!((24..32).contains(&logged.len()), "{}", logged.len());
        assert_eq!(
            logged.iter().sum::<u64>() + logged.len() as u64 + tally.unlogged,
            20 * 86_400
        );
    }
}
