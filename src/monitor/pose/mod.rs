//! Our own pose error, from what all beams share against all claims.

pub(super) mod bias;
pub(super) mod consensus;
pub(super) mod displacement;
pub(super) mod search;
pub(super) mod wander;
pub(super) mod witness;
