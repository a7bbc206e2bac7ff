//! What a read of the journal's outbox brought for one endpoint.

use crate::journal::{self, EndpointRecord, Recorded, Waiting};

/// A delivery and, where a cool-down has to judge it, its event.
pub(super) type Delivery = (Option<Recorded>, Waiting);

/// What the disk answered.
pub(super) struct Found {
    pub lane: usize,
    /// The last event when it was asked.
    pub last: u64,
    pub answer: Result<(EndpointRecord, Vec<Delivery>), journal::Error>,
}
