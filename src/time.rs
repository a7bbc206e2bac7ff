//! Time between stamps.

use jiff::Timestamp;

/// Seconds from `from` to `to`.
pub fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    let ns = to.as_nanosecond() - from.as_nanosecond();
    // Of 64 bits a conversion is one instruction, of 128 a call.
    i64::try_from(ns).map_or_else(|_| ns as f64, |ns| ns as f64) * 1e-9
}
