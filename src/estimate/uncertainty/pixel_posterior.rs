//! The posterior of a position along an axis whose pixels are wide against the spot.
//!
//! A spot within one pixel determines only which one: the deviance is flat within the pixel and steep at its edges, and the information
//! matrix, a local slope, is far too small or far too large. Here the deviance is evaluated along the axis, with the energy solved at
//! each position, and used as a posterior with a flat prior: its mean is the position of least squared error.

use crate::estimate::dense_linalg::dot;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;

/// With pixels wider than this, σ, the deviance is no parabola at any signal-to-noise ratio of interest.
pub(crate) const WIDE_PIXEL: f64 = 2.0;
/// Step of the quadrature, and its range on either side of a pixel's edge, σ: beyond six no light crosses the edge.
const STEP: f64 = 0.1;
const AROUND: f64 = 6.0;

/// Posterior moments of a position along an axis, σ and σ².
pub(crate) struct PixelPosterior {
    /// Posterior mean less the fitted position.
    pub shift: f64,
    pub variance: f64,
    /// Information at the fitted position with unknown energy and no other source near.
    pub information: f64,
}

/// Posterior along `axis` (0 for x) about `spot`; `None` where pixels are narrow enough for the information matrix.
pub(crate) fn pixel_posterior(bases: [&Basis; 2], axis: usize, spot: &PointSource) -> Option<PixelPosterior> {
    let b = bases[axis];
    let pitch = b.pitch();
    if pitch <= WIDE_PIXEL {
        return None;
    }
    let [other, _] = profile(bases[1 - axis], spot.u[1 - axis]);
    let light = spot.a * spot.a * dot(&other, &other);
    let u = spot.u[axis];
    let [here, slope] = profile(b, u);
    let whole = dot(&here, &here);
    let places = places(b, u);
    let chances: Vec<f64> = places
        .iter()
        .map(|&p| {
            let [there, _] = profile(b, p);
            let (both, own) = (dot(&here, &there), dot(&there, &there));
            // Squared light that a spot here cannot explain with any energy.
            let left = if own > 0.0 { whole - both * both / own } else { whole };
            (-0.5 * light * left.max(0.0)).exp()
        })
        .collect();
    let moment = |f: &dyn Fn(f64) -> f64| {
        let g = |k: usize| chances[k] * f(places[k] - u);
        (1..places.len())
            .map(|k| 0.5 * (g(k) + g(k - 1)) * (places[k] - places[k - 1]))
            .sum::<f64>()
    };
    let mass = moment(&|_| 1.0);
    let shift = moment(&|t| t) / mass;
    let variance = moment(&|t| (t - shift).powi(2)) / mass;
    let unexplained = dot(&slope, &slope) - dot(&slope, &here).powi(2) / whole;
    (shift.is_finite() && variance > 0.0 && unexplained.is_finite()).then_some(PixelPosterior {
        shift,
        variance,
        information: light * unexplained.max(0.0),
    })
}

/// Pixel fractions over the whole axis, and their derivatives.
fn profile(b: &Basis, u: f64) -> [Vec<f64>; 2] {
    let (mut f, mut f1, mut f2) = (vec![0.0; b.n], vec![0.0; b.n], vec![0.0; b.n]);
    psf_table::profile(&b.edges, u, 1.0, psf_table::REACH, &mut f, &mut f1, &mut f2);
    [f, f1]
}

/// Quadrature nodes around the edges of the spot's pixel and its neighbours, and around `u`, in order.
fn places(b: &Basis, u: f64) -> Vec<f64> {
    let pixel = (((u - b.edges[0]) / b.pitch()).floor().max(0.0) as usize).min(b.n - 1);
    let (first, last) = (pixel.saturating_sub(1), (pixel + 2).min(b.n));
    let reach = AROUND.min(0.5 * b.pitch());
    let steps = (reach / STEP).ceil() as i32;
    let around = |edge: f64| (-steps..=steps).map(move |k| edge + reach * f64::from(k) / f64::from(steps));
    let mut places: Vec<f64> = b.edges[first..=last].iter().flat_map(|&e| around(e)).collect();
    // A steep deviance changes within less than a step of `u`.
    places.extend((-40..=40).map(|k| u + 1e-3 * STEP * f64::from(k).powi(3).abs().copysign(f64::from(k)) / 64.0));
    places.retain(|p| (b.min_position()..=b.max_position()).contains(p));
    places.sort_by(f64::total_cmp);
    places
}
