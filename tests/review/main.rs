//! The whole chain from pixels to alerts, on scenes of the simulator: what must be raised, when, and nothing else.

mod attacks;
mod faults;
mod honest;
mod px4_log;
mod stage;
mod tracks;
