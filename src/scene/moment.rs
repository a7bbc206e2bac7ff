//! One frame's place in time and in the random streams.

use super::stream::{Ledger, Streams};

/// Frame number, time and where its randomness comes from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment<'a> {
    pub k: u64,
    pub t: f64,
    pub streams: Streams,
    pub ledger: &'a Ledger,
}
