//! The number of emitters: hypotheses are proposed, fitted and compared.

pub mod map_search;
pub mod nuisance_selection;
pub mod power_prior;
pub mod proposals;
pub mod reweighting;
pub mod search;
