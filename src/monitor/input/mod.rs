//! What the monitor is given: frames, claims and their times, and how far each can be trusted.

pub(super) mod claim_state;
pub(super) mod claim_timing;
pub(super) mod clock_offset;
pub(super) mod crowding;
pub(super) mod overload;
pub(super) mod sensor_health;
