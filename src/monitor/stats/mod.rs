//! Statistics over plain numbers: each takes samples and gives a p-value or an estimate. None of them knows of alerts.

pub(super) mod block_history;
pub(super) mod brightness;
pub(super) mod claim_consistency;
pub(super) mod co_location;
pub(super) mod error_budget;
pub(super) mod gaussian;
pub(super) mod jitter;
pub(super) mod lamp_or_beam;
pub(super) mod moment_blocks;
pub(super) mod moment_score;
pub(super) mod robust;
pub(super) mod second_moment;
pub(super) mod step_change;
pub(super) mod widening;
pub(super) mod window_excess;
