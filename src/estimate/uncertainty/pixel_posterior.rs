//! Where an emitter may be along an axis whose pixels are wide against the spot.
//!
//! A spot that lies in one pixel says only which one: the deviance is flat within it and steep at its edges, and the
//! information matrix, which sees the slope at one place, says either too little or far too much. Here the deviance is
//! followed along the axis instead, with the energy solved anew at each place, and taken for a posterior with a flat prior:
//! its mean is the position of least squared error, and its variance is what is claimed.

use crate::estimate::dense_linalg::dot;
use crate::estimate::model::hypothesis::Spot;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;

/// Pixels wider than this, σ, make the deviance no parabola at any signal-to-noise ratio of interest.
pub(crate) const WIDE: f64 = 2.0;
/// Distance between the places that are tried, and how far to either side of a pixel's edge, σ.
const STEP: f64 = 0.1;
const AROUND: f64 = 6.0;

/// What the deviance says of a position along an axis, σ and σ².
pub(crate) struct Spread {
    /// From the fitted position to the mean of the places where it may be.
    pub shift: f64,
    pub variance: f64,
    /// Information at the fitted position, with the energy unknown and no other emitter near.
    pub information: f64,
}

/// Follows the deviance along `axis` (0 for x) about `spot`; `None` where pixels are narrow enough for the information matrix.
pub(crate) fn along(bases: [&Basis; 2], axis: usize, spot: &Spot) -> Option<Spread> {
    let b = bases[axis];
    let pitch = b.pitch();
    if pitch <= WIDE {
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
            // Light that this place cannot explain with any energy.
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
    (shift.is_finite() && variance > 0.0 && unexplained.is_finite()).then_some(Spread {
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

/// Places around the edges of the spot's pixel and of its neighbours, and `u` itself, in order.
fn places(b: &Basis, u: f64) -> Vec<f64> {
    let pixel = (((u - b.edges[0]) / b.pitch()).floor().max(0.0) as usize).min(b.n - 1);
    let (first, last) = (pixel.saturating_sub(1), (pixel + 2).min(b.n));
    let reach = AROUND.min(0.5 * b.pitch());
    let steps = (reach / STEP).ceil() as i32;
    let around = |edge: f64| (-steps..=steps).map(move |k| edge + reach * f64::from(k) / f64::from(steps));
    let mut places: Vec<f64> = b.edges[first..=last].iter().flat_map(|&e| around(e)).collect();
    // A steep deviance falls off within less than a step of the estimate.
    places.extend((-40..=40).map(|k| u + 1e-3 * STEP * f64::from(k).powi(3).abs().copysign(f64::from(k)) / 64.0));
    places.retain(|p| (b.lowest()..=b.highest()).contains(p));
    places.sort_by(f64::total_cmp);
    places
}
