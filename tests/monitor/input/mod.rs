mod claim_timing;
mod clock_offset;
mod crowding;
