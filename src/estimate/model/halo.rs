//! The noise that an inexact PSF adds: a share of the spots' light, spread over a halo as wide as those of real lenses.
//!
//! A pixel's variance is 1 + (spot_error·H)² in units of the noise, with H² = Σ (a·√G·h(d))² over the sources, h(d) = 1/(1 + (d/3σ)²), and G
//! a spot's sum of squares over the pixels. With √G a misplaced spot-shaped bump of the share `spot_error` of a source's light has a
//! significance of one at the source itself, whatever the pixel pitch; a share that does not depend on the pixels would average out where
//! they are many. The profile falls with the square of the distance: slower than the halo of a Moffat profile of index 2.5 (d⁻⁵) and the
//! rings of an Airy disc (d⁻³), and slow enough that a ghost reflection at 10 σ is covered.

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

/// The spots' halo at each pixel, (Ny, Nx), in units of the noise.
pub(crate) struct Halo {
    /// H², over all sources.
    pub square: Vec<f64>,
    /// H² less the largest single source's part: what others scatter there.
    pub square_of_others: Vec<f64>,
}

impl Halo {
    pub fn new(bases: &Bases, sources: &[PointSource]) -> Self {
        dispatch!(<'a>
            bases: &'a Bases = bases,
            sources: &'a [PointSource] = sources
            => Halo: Halo::over_pixels(bases, sources))
    }

    #[inline(always)]
    fn over_pixels(bases: &Bases, sources: &[PointSource]) -> Self {
        let (bx, by) = (&bases.x, &bases.y);
        let norm = spot_norm(bases);
        let centre = |b: &Basis, k: usize| 0.5 * (b.edges[k] + b.edges[k + 1]);
        let mut square = vec![0.0; bx.n * by.n];
        let mut largest = vec![0.0f64; bx.n * by.n];
        for source in sources {
            let own = source.a.max(0.0) * norm;
            let columns: Vec<f64> = (0..bx.n).map(|k| (centre(bx, k) - source.u[0]).powi(2)).collect();
            let rows = square.chunks_exact_mut(bx.n).zip(largest.chunks_exact_mut(bx.n));
            for (y, (square, largest)) in rows.enumerate() {
                let dy2 = (centre(by, y) - source.u[1]).powi(2);
                for ((h, most), dx2) in square.iter_mut().zip(largest).zip(&columns) {
                    let part = (own * height(dx2 + dy2)).powi(2);
                    *h += part;
                    *most = if part > *most { part } else { *most };
                }
            }
        }
        let square_of_others = square.iter().zip(&largest).map(|(h, most)| h - most).collect();
        Self {
            square,
            square_of_others,
        }
    }
}
