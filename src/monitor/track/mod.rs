pub(super) mod association;
pub(super) mod detection;
pub(super) mod kalman;
pub(super) mod tracker;
