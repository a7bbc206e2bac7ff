//! Maximum likelihood with the number of emitters unknown.

use crate::estimate::model::hypothesis::{Hypothesis, Width};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::initialise::add_residual_peaks;
use crate::estimate::model_order::nuisance_proposals::{drop_nuisances, with_more_nuisances};
use crate::estimate::model_order::nuisance_selection::{
    EARLY_ROUNDS, ROUNDS, has_paired_sources, has_unequal_energies, nuisances_can_replace_sources, select_nuisances,
    try_rotated_ellipse, try_width_for_pairs,
};
use crate::estimate::model_order::pruning::prune_spurious;
use crate::estimate::model_order::refine::refine;
use crate::estimate::model_order::search::Search;

/// Misfit in standard deviations from which nuisances are tried; twice that of an explained frame, so that no honest frame pays.
const MISFIT_DEVIATIONS: f64 = 5.0;
/// Overlapping sources above this number are first tested for nuisances: refining so many costs more than the test.
const MAX_CLUSTER: usize = 10;
/// Share of the work that is left for the last refinement, whatever the search for nuisances has spent.
const LAST_SHARE: f64 = 0.3;

/// The hypothesis that scores best, from an initial one. Nuisances are fitted only where the frame cannot be explained without, and then
/// within every hypothesis. Ends early where noise that grows with the light is suspected; see [`Search::suspected_variance`].
pub(crate) fn maximum_likelihood(search: &mut Search, initial: Hypothesis) -> Hypothesis {
    let rules = search.rules();
    let plain = initial.nuisances;
    let first = initial.clone();
    let mut candidate = Candidate::from(initial);
    if search.pencil.is_none() {
        candidate = add_residual_peaks(search, candidate);
    }
    if search.suspected_variance.is_some() {
        return candidate.into_hypothesis();
    }
    let mut is_settled = search.is_explained_by(&candidate);
    if is_settled {
        refine(search, &mut candidate, ROUNDS);
        if rules.width_for_pairs && search.pencil.is_none() && !search.is_measured() {
            try_width_for_pairs(search, &mut candidate);
        }
    } else {
        reinitialise(search, &mut candidate);
    }
    let compressed = search.compressed();
    let is_far = compressed.misfit(&candidate) > 1.0 + MISFIT_DEVIATIONS * (2.0 / compressed.data_count).sqrt();
    if is_far
        || candidate.nuisances != plain
        || has_unequal_energies(search, &candidate) && nuisances_can_replace_sources(search, &candidate)
    {
        if rules.select_nuisances && !search.is_measured() {
            select_nuisances(search, &mut candidate);
        }
        is_settled = false;
    }
    // An elliptical PSF takes several sources for one emitter.
    let may_be_turned = match search.pencil {
        None => has_paired_sources(&candidate),
        Some(_) => {
            !is_settled
                && has_unequal_energies(search, &candidate)
                && 3 * candidate.sources.len() > 4 * first.sources.len()
        }
    };
    let is_unexplained = !is_settled && !search.is_explained_by(&candidate);
    if rules.rotated_ellipse && !search.is_measured() && (may_be_turned || is_unexplained) {
        try_rotated_ellipse(search, first, &mut candidate);
        is_settled = false;
    }
    if !is_settled {
        search.context.budget.reserve(LAST_SHARE);
        refine(search, &mut candidate, ROUNDS);
    }
    drop_nuisances(search, &mut candidate);
    if rules.prune_spurious && !search.is_explained_by(&candidate) {
        prune_spurious(search, &mut candidate);
    }
    search.converge(&mut candidate);
    candidate.into_hypothesis()
}

/// Escapes a local minimum: frees nuisances, refits, removes them, then applies proposals. A result with more than one further source
/// is discarded. Where only the fit with nuisances explains the frame, they stay.
fn reinitialise(search: &mut Search, candidate: &mut Candidate) {
    let first = candidate.clone();
    let mut wide = None;
    if search.rules().free_nuisances && search.pencil.is_some() {
        let mut free = first.clone();
        free.nuisances = search.with_background(Width::Common);
        search.fit_trial(&mut free);
        wide = Some(free.clone()).filter(|w| search.is_explained_by(w));
        free.restrict_nuisances(first.nuisances);
        search.fit_trial(&mut free);
        search.keep_better(candidate, free);
    }
    if !search.is_explained_by(candidate) && first.sources.len() <= MAX_CLUSTER {
        refine(search, candidate, EARLY_ROUNDS);
    }
    if candidate.sources.len() > first.sources.len() + 1 {
        *candidate = first;
    }
    if let Some(mut wide) = wide.filter(|_| !search.is_explained_by(candidate)) {
        refine(search, &mut wide, EARLY_ROUNDS);
        if !has_unequal_energies(search, &wide) {
            search.keep_better(candidate, wide);
        }
    }
}

/// Refits `hypothesis` under new weights: nuisances where the frame is not explained, then proposals.
pub(crate) fn refit_reweighted(search: &mut Search, hypothesis: Hypothesis, rounds: usize) -> Hypothesis {
    let mut candidate = Candidate::from(hypothesis);
    search.fit_trial(&mut candidate);
    if !search.is_explained_by(&candidate)
        && let Some(wider) = with_more_nuisances(search, &candidate, &candidate)
    {
        candidate = wider;
    }
    refine(search, &mut candidate, rounds);
    drop_nuisances(search, &mut candidate);
    candidate.into_hypothesis()
}
