//! What a hypothesis predicts: the PSF on one axis, its compressed basis, and sums of separable terms.

pub mod bases;
pub mod compressed_frame;
pub mod halo;
pub mod hypothesis;
pub mod measured_components;
#[cfg(test)]
mod measured_components_test;
pub mod measured_terms;
mod patch_pool;
pub mod psf_table;
pub mod separable_model;
pub mod separable_terms;
pub mod svd_basis;
