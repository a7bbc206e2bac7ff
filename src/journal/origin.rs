//! Where an event comes from that another journal had first.

use std::sync::Arc;

/// An event's place in the journal that had it first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// The other journal's name.
    pub source: Arc<str>,
    pub seq: u64,
}
