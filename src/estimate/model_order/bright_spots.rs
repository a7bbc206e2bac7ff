//! The bright spots of a hypothesis: what stands beside them may be a part of their light.

use crate::estimate::model::halo;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model_order::proposals::disjoint_close_pairs;

/// Sources nearer than this to a brighter one, σ, may be a part of its spot whatever their energy.
pub(crate) const CORE: f64 = 2.5;
/// Relative difference up to which the distances between the sources of two pairs are alike.
const ALIKE: f64 = 0.2;
/// Largest share of a bright source's light, times the halo's height, that a misfit may look like.
const SATELLITE: f64 = 0.5;

/// The bright spots of a hypothesis: what is faint beside a brighter source is left out, as it may be that one's misfit. `merge_core`: what
/// stands in a brighter source's core is merged with it whatever its energy.
pub(crate) fn bright_spots(hypothesis: &Hypothesis, merge_core: bool) -> Vec<PointSource> {
    let mut sources = hypothesis.sources.clone();
    sources.sort_by(|a, b| b.a.total_cmp(&a.a));
    // Each spot with its brightest source.
    let mut spots: Vec<[PointSource; 2]> = Vec::new();
    for source in sources {
        let is_in_core = |head: &PointSource| merge_core && distance2(head.u, source.u) < CORE * CORE;
        if let Some([spot, _]) = spots.iter_mut().find(|[_, head]| is_in_core(head)) {
            let whole = spot.a + source.a;
            for k in 0..2 {
                spot.u[k] = (spot.a * spot.u[k] + source.a * source.u[k]) / whole;
            }
            spot.a = whole;
        } else if !spots.iter().any(|[_, head]| is_faint_beside(&source, head)) {
            spots.push([source; 2]);
        }
    }
    spots.into_iter().map(|[spot, _]| spot).collect()
}

/// Whether a source may be a part of the spot of a brighter one.
pub(crate) fn is_faint_beside(source: &PointSource, head: &PointSource) -> bool {
    source.a < SATELLITE * halo::height(distance2(head.u, source.u)) * head.a
}

/// Whether nearly all spots are pairs along the same direction and equally far apart, as an elongated spot is explained by a model that is
/// round.
pub(crate) fn are_pairs_alike(hypothesis: &Hypothesis) -> bool {
    let spots = bright_spots(hypothesis, true).len();
    let pairs: Vec<[f64; 2]> = disjoint_close_pairs(hypothesis, CORE)
        .into_iter()
        .map(|(i, j)| [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k]))
        .collect();
    let is_alike = |a: &[f64; 2], b: &[f64; 2]| {
        let flip = (a[0] * b[0] + a[1] * b[1]).signum();
        distance2(*a, b.map(|v| flip * v)) < (ALIKE * a[0].hypot(a[1])).powi(2)
    };
    let most = pairs
        .iter()
        .map(|a| pairs.iter().filter(|b| is_alike(a, b)).count())
        .max();
    most.is_some_and(|most| most > 2 && 4 * most >= 3 * spots)
}

pub(crate) fn distance2(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}
