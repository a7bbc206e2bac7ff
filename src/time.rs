//! Time between stamps.

use jiff::Timestamp;

/// Seconds from `from` to `to`.
pub fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    (to.as_nanosecond() - from.as_nanosecond()) as f64 * 1e-9
}
