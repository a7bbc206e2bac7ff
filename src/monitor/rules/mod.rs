pub(super) mod co_located;
pub(super) mod inputs;
pub(super) mod mismatch;
pub(super) mod unclaimed;
