//! The number of emitters: hypotheses are proposed, fitted and compared.

pub mod bright_spots;
pub mod candidate;
pub mod common_misfit;
pub mod criterion;
pub mod ellipse_history;
pub mod evidence;
pub mod initialise;
pub mod learned_spot;
pub mod map_search;
pub mod maximum_likelihood;
pub mod nuisance_proposals;
pub mod nuisance_selection;
pub mod power_prior;
pub mod proposals;
#[cfg(test)]
mod proposals_test;
pub mod pruning;
pub mod refine;
pub mod reweighting;
pub mod ring_misfit;
pub mod search;
pub mod spot_error;
pub mod spot_error_history;
pub mod spot_views;
pub mod stacked_misfit;
