//! Number, time and random streams of one frame.

use super::stream::{Ledger, Streams};

/// Frame number, time and random streams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment<'a> {
    pub k: u64,
    pub t: f64,
    pub streams: Streams,
    pub ledger: &'a Ledger,
}
