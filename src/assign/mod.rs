//! Floor 1: optimal assignment with dummies, and the scores that rest on it.

mod lap;
mod ospa;

pub use lap::{Matching, assign};
pub use ospa::{Ospa, ospa};
