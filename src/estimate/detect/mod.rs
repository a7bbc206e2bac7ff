//! Starting points for a fit: matched filter, matrix pencil, heatmap network.

pub mod heatmap_network;
pub mod matched_filter;
pub mod matrix_pencil;
