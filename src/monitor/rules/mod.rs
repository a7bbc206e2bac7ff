//! The rules. Each reads a [`FrameContext`](super::frame_context::FrameContext), keeps what it must remember in a `Memory` of its own
//! and returns findings; none of them changes an alert, a track or another rule's memory.

pub(super) mod co_located;
pub(super) mod flashes;
pub(super) mod inputs;
pub(super) mod known_light;
pub(super) mod mismatch;
pub(super) mod pose;
pub(super) mod unclaimed;
pub(super) mod unseen;
pub(super) mod watched_spot;
pub(super) mod zone;
