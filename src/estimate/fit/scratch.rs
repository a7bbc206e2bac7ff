//! Buffers of the parts of a fit.

use crate::estimate::fit::amplitudes::AmplitudeSystem;

/// Buffers whose contents nobody reads after the function that filled them.
#[derive(Default)]
pub(crate) struct Scratch {
    pub amplitudes: AmplitudeSystem,
    /// A Cholesky factor of the normal equations, (p, p).
    pub factor: Vec<f64>,
    /// A solution or a row of the Jacobian, (p).
    pub vector: Vec<f64>,
    /// A second derivative or a weighted derivative of the predicted frame, (my, mx).
    pub matrix: Vec<f64>,
    /// Profiles along an axis.
    pub profiles: Vec<f64>,
    /// Sums over one axis.
    pub strip: Vec<f64>,
}
