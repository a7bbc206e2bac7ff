pub(super) mod claim_state;
pub(super) mod claim_timing;
pub(super) mod clock_offset;
pub(super) mod crowding;
pub(super) mod sensor_health;
