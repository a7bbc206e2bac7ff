//! What exports say of an alert in words.

use crate::claim::escape_undisplayable;
use crate::monitor::{Alert, TrackedPosition};
use crate::word::word;

/// The kind as words: `unclaimed emitter`.
pub(super) fn title(alert: &Alert) -> String {
    word(alert.kind).replace('_', " ")
}

/// `unclaimed emitter at x 1.50 m, y -2.50 m (± 0.30 m)`; names cannot change how a line is drawn.
pub(super) fn sentence(alert: &Alert) -> String {
    let mut text = title(alert);
    if let Some(user) = &alert.user {
        text += &format!(": user {}", escape_undisplayable(user));
    }
    if let Some((x, y)) = alert.x_m.zip(alert.y_m) {
        text += &format!(" at x {x:.2} m, y {y:.2} m");
    }
    if let Some(sigma) = alert.cov_m2.as_ref().and_then(sigma_m) {
        text += &format!(" (± {sigma:.2} m)");
    }
    text
}

/// A track among those of all stations.
pub(super) fn track(emitter: &TrackedPosition) -> String {
    match &emitter.station {
        Some(station) => format!("{station}.{}", emitter.track),
        None => emitter.track.to_string(),
    }
}

/// Standard deviation along the worst direction, m.
pub(super) fn sigma_m([[a, b], [_, c]]: &[[f64; 2]; 2]) -> Option<f64> {
    let largest = 0.5 * (a + c) + (0.5 * (a - c)).hypot(*b);
    Some(largest.max(0.0).sqrt()).filter(|sigma| sigma.is_finite())
}
