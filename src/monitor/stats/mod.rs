pub(super) mod claim_consistency;
pub(super) mod co_location;
pub(super) mod error_budget;
pub(super) mod second_moment;
pub(super) mod step_change;
