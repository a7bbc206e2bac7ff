//! The noise that an inexact PSF adds: a share of the spots' light, spread over a halo as wide as those of real lenses.
//!
//! A pixel's variance is 1 + (spot_error·H)² in units of the noise, with H² = Σ (a·√G·h(d))² over the sources, h(d) = 1/(1 + (d/3σ)²), and G
//! a spot's sum of squares over the pixels. With √G a misplaced spot-shaped bump of the share `spot_error` of a source's light has a
//! significance of one at the source itself, whatever the pixel pitch; a share that does not depend on the pixels would average out where
//! they are many. Farther out than a learned shape is known, the spot error is the shape's own for there. The profile falls with the square
//! of the distance: slower than the halo of a Moffat profile of index 2.5 (d⁻⁵) and the rings of an Airy disc (d⁻³), and slow enough that a
//! ghost reflection at 10 σ is covered.

use crate::estimate::dense_linalg::dispatch;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model::svd_basis::Basis;

/// Half-width of the halo at half its height, σ: wider hides more faint sources, narrower leaves comatic tails outside.
const HALF_WIDTH: f64 = 3.0;

/// Height of the halo at a squared distance, σ², relative to its centre.
#[inline(always)]
pub(crate) fn height(distance2: f64) -> f64 {
    1.0 / (1.0 + distance2 * (1.0 / (HALF_WIDTH * HALF_WIDTH)))
}

/// Norm of a spot of unit energy over the pixels, √G.
pub(crate) fn spot_norm(bases: &Bases) -> f64 {
    norm_of_pitches(bases.axes().map(Basis::pitch))
}

/// The same for pixels of these pitches along x and y, σ.
pub(crate) fn norm_of_pitches(pitches: [f64; 2]) -> f64 {
    let norm = |pitch: f64| (pitch / (2.0 * std::f64::consts::PI.sqrt())).sqrt().min(1.0);
    pitches.map(norm).iter().product()
}

/// The share of a spot's light by which it may differ from the model, by the distance from its centre.
#[derive(Clone, Copy)]
pub(crate) struct ErrorByDistance {
    within: f64,
    beyond: f64,
    /// Square of the distance between the two, σ².
    from2: f64,
}

impl ErrorByDistance {
    pub fn new(bases: &Bases, within: f64) -> Self {
        let beyond = bases.shape.as_ref().and_then(|shape| shape.beyond());
        let (beyond, from) = beyond.unwrap_or((within, f64::INFINITY));
        Self {
            within,
            beyond: beyond.max(within),
            from2: from * from,
        }
    }

    #[inline(always)]
    pub fn at(&self, distance2: f64) -> f64 {
        if distance2 < self.from2 {
            self.within
        } else {
            self.beyond
        }
    }
}

/// The variance that an inexact PSF adds at each pixel, (Ny, Nx), in units of the noise.
pub(crate) struct Halo {
    /// Of all sources.
    pub variance: Vec<f64>,
    /// Less the largest single source's part: what others scatter there.
    pub variance_of_others: Vec<f64>,
}

impl Halo {
    pub fn new(bases: &Bases, sources: &[PointSource], spot_error: f64) -> Self {
        dispatch!(<'a>
            bases: &'a Bases = bases,
            sources: &'a [PointSource] = sources,
            error: ErrorByDistance = ErrorByDistance::new(bases, spot_error)
            => Halo: Halo::over_pixels(bases, sources, error))
    }

    #[inline(always)]
    fn over_pixels(bases: &Bases, sources: &[PointSource], error: ErrorByDistance) -> Self {
        let (bx, by) = (&bases.x, &bases.y);
        let norm = spot_norm(bases);
        let centre = |b: &Basis, k: usize| 0.5 * (b.edges[k] + b.edges[k + 1]);
        let mut variance = vec![0.0; bx.n * by.n];
        let mut largest = vec![0.0f64; bx.n * by.n];
        for source in sources {
            let own = source.a.max(0.0) * norm;
            let columns: Vec<f64> = (0..bx.n).map(|k| (centre(bx, k) - source.u[0]).powi(2)).collect();
            let rows = variance.chunks_exact_mut(bx.n).zip(largest.chunks_exact_mut(bx.n));
            for (y, (variance, largest)) in rows.enumerate() {
                let dy2 = (centre(by, y) - source.u[1]).powi(2);
                for ((sum, most), dx2) in variance.iter_mut().zip(largest).zip(&columns) {
                    let distance2 = dx2 + dy2;
                    let part = (error.at(distance2) * own * height(distance2)).powi(2);
                    *sum += part;
                    *most = if part > *most { part } else { *most };
                }
            }
        }
        let variance_of_others = variance.iter().zip(&largest).map(|(all, most)| all - most).collect();
        Self {
            variance,
            variance_of_others,
        }
    }
}
