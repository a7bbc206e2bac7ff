//! Layer 1: optimal assignment with dummies, and the metrics based on it.

mod gospa;
mod lap;
mod ospa;

pub use gospa::{Gospa, gospa};
pub use lap::{Matching, assign};
pub use ospa::{Ospa, ospa};
