//! Floor 2: what a device is, from frames with known positions.

pub mod file;
pub mod truth;
