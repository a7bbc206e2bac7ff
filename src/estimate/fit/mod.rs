//! Levenberg–Marquardt over all sources of a hypothesis.

pub mod amplitudes;
pub mod context;
pub mod damped_step;
pub mod evaluation;
#[cfg(test)]
mod fit_test;
pub mod levenberg_marquardt;
pub mod normal_equations;
pub mod problem;
pub mod profile_constraint;
pub mod scratch;
pub mod source_groups;
pub mod work_budget;
pub mod workspace;
