//! From an estimate to tracks, and from tracks to the claims that they are associated with.

pub(super) mod association;
pub(super) mod beam_track;
pub(super) mod common_course;
pub(super) mod detection;
pub(super) mod eligibility;
pub(super) mod identity;
mod kalman;
pub(super) mod manoeuvring;
pub(super) mod registration;
pub(super) mod tracker;
pub(super) mod user_track;
pub(super) mod user_tracks;
