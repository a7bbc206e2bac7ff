//! Rows of the outbox of webhooks and exports and what the journal remembers of each endpoint.

use std::sync::Arc;

use arc_swap::ArcSwap;
use jiff::Timestamp;

use crate::monitor::{AlertEvent, AlertKind};

/// Which events one endpoint receives; the outbox gets a row for each event that matches.
#[derive(Clone, Debug, PartialEq)]
pub struct Subscription {
    /// The endpoint's name in the journal; stable over restarts.
    pub endpoint: String,
    /// All kinds when `None`.
    pub kinds: Option<Vec<AlertKind>>,
    /// Whether what an operator does to an alert is an event too, and at a hub who else reports it; it is no news to most receivers.
    pub has_operator_acts: bool,
}

/// The subscriptions in force.
pub(super) type Subscriptions = Arc<ArcSwap<Vec<Subscription>>>;

/// An outbox row that is still to be sent.
#[derive(Clone, Debug, PartialEq)]
pub struct Waiting {
    pub seq: u64,
    pub endpoint: String,
    pub alert: String,
    /// When the event was recorded, on the wall's clock.
    pub recorded_at: Timestamp,
    /// Steps of the retry schedule that are used up.
    pub step: u32,
    /// HTTP requests made so far.
    pub attempts: u32,
    pub next_at: Timestamp,
}

/// How one delivery attempt ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    pub seq: u64,
    pub endpoint: String,
    pub at: Timestamp,
    pub outcome: Outcome,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    Sent,
    Retry {
        step: u32,
        next_at: Timestamp,
        error: String,
    },
    /// The schedule is used up: kept, and sent again only on request.
    Dead {
        error: String,
    },
    /// Not to be sent at all: a cool-down folded it. No request was made.
    Withheld,
}

/// A delivery that the schedule gave up on.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct DeadLetter {
    pub seq: u64,
    pub alert: String,
    pub attempts: u32,
    #[schema(value_type = String, format = DateTime)]
    pub given_up_at: Timestamp,
    pub error: String,
}

/// What the journal remembers of an endpoint.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EndpointRecord {
    pub sent: u64,
    pub waiting: u64,
    pub dead: u64,
    /// When the oldest event that waits was recorded.
    pub oldest_waiting: Option<Timestamp>,
    pub last_success: Option<Timestamp>,
    pub last_failure: Option<Timestamp>,
    pub last_error: Option<String>,
    pub disabled_at: Option<Timestamp>,
}

/// Whether the zone or the maintenance of an alert leaves this endpoint among those that are sent it.
fn is_named(endpoint: &str, event: &AlertEvent) -> bool {
    let only = event.alert.webhooks.as_ref();
    only.is_none_or(|names| names.iter().any(|name| name == endpoint))
}

impl Subscription {
    pub fn wants(&self, event: &AlertEvent) -> bool {
        (self.has_operator_acts || event.event.is_news())
            && self
                .kinds
                .as_ref()
                .is_none_or(|kinds| kinds.contains(&event.alert.kind))
            && (self.has_operator_acts || is_named(&self.endpoint, event))
    }
}
