//! Floor 1: optimal assignment with dummies, and the scores that rest on it.

mod gospa;
mod lap;
mod ospa;

pub use gospa::{Gospa, gospa};
pub use lap::{Matching, assign};
pub use ospa::{Ospa, ospa};
