//! Starting points for a fit: matched filter, matrix pencil, heatmap network; the windows of a large frame.

pub mod heatmap_network;
pub mod matched_filter;
pub mod matrix_pencil;
pub mod segmentation;
mod templates;
