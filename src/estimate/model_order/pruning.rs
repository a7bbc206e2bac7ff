//! Removes sources that do not exceed the misfit around them: where gain scatter or a wrong PSF leaves a residual that grows with the
//! light, a source must be significant against that residual and not only against the noise.

use crate::estimate::model::hypothesis::PointSource;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::search::Search;

/// Wald statistic, in source penalties, from which a source is never pruned: no misfit of a usable PSF looks so bright.
const CERTAIN: f64 = 100.0;
/// Radius of the neighbourhood whose misfit a source must exceed, σ: it holds 86 % of a spot's light.
const NEIGHBOURHOOD: f64 = 2.0;

/// Removes the sources that noise alone may be, the least significant first: one of a pair may be needed. Takes no step of a fit.
pub(crate) fn drop_insignificant(search: &mut Search, candidate: &mut Candidate) {
    let threshold = search.criterion.threshold();
    loop {
        let significance = candidate.wald_statistics(&mut search.context);
        let by_significance = |i: &usize, j: &usize| {
            let energy = |k: usize| candidate.sources[k].a;
            let order = significance[*i].total_cmp(&significance[*j]);
            order.then(energy(*i).total_cmp(&energy(*j)))
        };
        let least = (0..significance.len()).min_by(by_significance);
        let Some(least) = least.filter(|&k| significance[k] < threshold) else {
            break;
        };
        candidate.sources.remove(least);
        candidate.converged = false;
    }
}

/// Removes spurious sources, the least significant first, until none is left.
pub(crate) fn prune_spurious(search: &mut Search, candidate: &mut Candidate) {
    while prune_one(search, candidate) {}
}

fn prune_one(search: &mut Search, candidate: &mut Candidate) -> bool {
    let penalty = search.criterion.source_penalty;
    let significance = candidate.wald_statistics(&mut search.context);
    let mut order: Vec<usize> = (0..significance.len()).collect();
    order.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
    for index in order.into_iter().take_while(|&i| significance[i] < CERTAIN * penalty) {
        let source = candidate.sources[index];
        let mut next = candidate.clone();
        next.sources.remove(index);
        search.fit_trial(&mut next);
        let around = misfit_around(search, &mut next, &source);
        if next.deviance - candidate.deviance < penalty * around {
            *candidate = next;
            return true;
        }
    }
    false
}

/// Mean squared residual per datum around a source, at least 1.
fn misfit_around(search: &mut Search, candidate: &mut Candidate, source: &PointSource) -> f64 {
    let (compressed, frame, bases) = (search.compressed(), search.frame, search.context.bases);
    let (bx, by) = (&bases.x, &bases.y);
    let mut image = Vec::new();
    let residual = &candidate.evaluation(&mut search.context).residual;
    compressed.expand_matrix(residual, bx, by, &mut image);
    let (mut sum, mut count) = (0.0, 0.0);
    for (k, r) in image.iter().enumerate().filter(|(k, _)| !frame.is_masked[*k]) {
        let x = bx.edges[k % bx.n] + 0.5 * bx.pitch() - source.u[0];
        let y = by.edges[k / bx.n] + 0.5 * by.pitch() - source.u[1];
        if x * x + y * y < NEIGHBOURHOOD * NEIGHBOURHOOD {
            sum += r * r;
            count += 1.0;
        }
    }
    let share = compressed.data_count / image.len() as f64;
    if count > 0.0 {
        (sum / count / share).max(1.0)
    } else {
        1.0
    }
}
