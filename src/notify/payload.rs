//! The JSON body of a webhook request.

use jiff::Timestamp;
use serde::Serialize;

use crate::journal::Recorded;
use crate::monitor::{Alert, AlertEventKind};

/// The body of a webhook: Standard Webhooks' `type`, `timestamp` and `data`, and beside them `event` and `alert`
/// as every other outlet of alert events has them, so that one reader serves all.
#[derive(Serialize)]
struct Payload<'a> {
    r#type: AlertEventKind,
    timestamp: Timestamp,
    data: &'a Alert,
    event: AlertEventKind,
    alert: &'a Alert,
}

pub(super) fn body(recorded: &Recorded) -> Vec<u8> {
    let event = &recorded.event;
    serde_json::to_vec(&Payload {
        r#type: event.event,
        timestamp: recorded.at,
        data: &event.alert,
        event: event.event,
        alert: &event.alert,
    })
    .expect("alerts hold no maps with keys other than strings")
}
