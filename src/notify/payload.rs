//! The JSON body of a webhook request.

use jiff::Timestamp;
use serde::Serialize;

use crate::journal::Recorded;
use crate::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};

/// The body of a webhook: Standard Webhooks' `type`, `timestamp` and `data`, and beside them `event` and `alert`
/// as every other outlet of alert events has them, so that one reader serves all.
#[derive(Serialize)]
struct Payload<'a, E> {
    r#type: E,
    timestamp: Timestamp,
    data: &'a Alert,
    event: E,
    alert: &'a Alert,
}

/// The type of the event that an operator sends to try a receiver.
const TEST: &str = "webhook.test";

pub(super) fn body(recorded: &Recorded, is_test: bool) -> Vec<u8> {
    let event = &recorded.event;
    match is_test {
        true => json(TEST, recorded.at, &event.alert),
        false => json(event.told_as(), recorded.at, &event.alert),
    }
}

/// An event that no alert stands behind: its alert says so.
pub fn test_event(now: Timestamp) -> Recorded {
    let alert = Alert {
        id: "test".to_owned(),
        kind: AlertKind::UnclaimedEmitter,
        severity: Severity::Info,
        state: AlertState::Cleared,
        raised_at: now,
        cleared_at: Some(now),
        user: None,
        x_m: Some(0.0),
        y_m: Some(0.0),
        z_m: Some(0.0),
        geodetic: None,
        cov_m2: Some([[1.0, 0.0], [0.0, 1.0]]),
        claimed: None,
        evidence: serde_json::json!({ "test": true }),
        source: AlertSource {
            kind: "test".to_owned(),
            frame: 0,
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    };
    Recorded {
        seq: 0,
        at: now,
        event: AlertEvent::new(AlertEventKind::Cleared, alert),
    }
}

fn json<E: Serialize + Copy>(event: E, timestamp: Timestamp, alert: &Alert) -> Vec<u8> {
    serde_json::to_vec(&Payload {
        r#type: event,
        timestamp,
        data: alert,
        event,
        alert,
    })
    .expect("alerts hold no maps with keys other than strings")
}
