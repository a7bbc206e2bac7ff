//! The status of one endpoint, as `/v1/webhooks` shows it.

use jiff::Timestamp;

use super::Endpoint;
use crate::monitor::AlertKind;

/// How one webhook or export fares. Holds no secret, and of the URL neither query nor credentials.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct EndpointStatus {
    pub name: String,
    /// "webhook", or the kind of the export.
    pub kind: &'static str,
    pub url: String,
    /// `null` is all.
    pub kinds: Option<Vec<AlertKind>>,
    pub state: EndpointState,
    /// Deliveries still to be made, those that a cool-down holds back included.
    pub queued: u64,
    pub sent: u64,
    /// Events since the start that a cool-down kept from the receiver: causes that came back and were gone again.
    pub withheld: u64,
    /// Dead letters: given up at the end of the retry schedule, kept, sent again on request.
    pub failed: u64,
    /// When the oldest event that is still queued was recorded.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub oldest_queued: Option<Timestamp>,
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_success: Option<Timestamp>,
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_failure: Option<Timestamp>,
    pub last_error: Option<String>,
    /// When the next request goes out, if nothing happens before.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub next_attempt: Option<Timestamp>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum EndpointState {
    Working,
    /// The last request failed; it is tried again.
    Failing,
    /// The receiver answered 410 Gone; nothing is sent until someone enables it.
    Disabled,
}

impl EndpointStatus {
    pub(super) fn new(endpoint: &Endpoint) -> Self {
        Self {
            name: endpoint.name.clone(),
            kind: endpoint.kind,
            url: endpoint.shown_url.clone(),
            kinds: endpoint.kinds.clone(),
            state: EndpointState::Working,
            queued: 0,
            sent: 0,
            withheld: 0,
            failed: 0,
            oldest_queued: None,
            last_success: None,
            last_failure: None,
            last_error: None,
            next_attempt: None,
        }
    }
}

/// What came back when an operator sent a test event.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct TestOutcome {
    /// The receiver confirmed it.
    pub delivered: bool,
    /// What the receiver answered; null where it did not.
    pub status: Option<u16>,
    /// Until the answer or the failure, ms.
    pub took_ms: u64,
    /// Why it was not delivered.
    pub error: Option<String>,
}
