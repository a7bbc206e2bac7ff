//! Levenberg–Marquardt over all emitters of a hypothesis.

pub mod amplitudes;
pub mod damped_step;
#[cfg(test)]
mod descent_test;
pub mod levenberg_marquardt;
pub mod normal_equations;
pub mod source_groups;
pub mod work_budget;
