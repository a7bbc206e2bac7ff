//! Starting points of a search: the matrix pencil's positions where spots overlap, residual peaks elsewhere.

use std::ops::RangeInclusive;

use crate::estimate::detect::matched_filter::Peak;
use crate::estimate::detect::matrix_pencil::MatrixPencil;
use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource, Width};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::nuisance_proposals::with_more_nuisances;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::noise_variance::VarianceFunction;

/// Extra emitters accepted before testing a background or width: a background brings several peaks at once, and the test costs three fits.
const ACCEPTED_EXTRA: usize = 2;
/// Steps of a fit from the pencil's positions; overlapping sources take many, and the count with the best fit is kept.
const PENCIL_FIT_STEPS: usize = 100;
/// Peaks below this share of the highest one wait for the next round: what an imperfect fit leaves around a bright source would pass for
/// faint ones.
const STRONG_PEAK: f64 = 0.1;
/// Most peaks that are fitted together where no hypothesis is searched, the strongest: a step's time grows with the cube of their number, its
/// memory with the square.
const MOST_PEAKS: usize = 300;
/// A rival that leaves less than this share of the deviance is no sign of noise that grows with the light: sources explain it.
const RIVAL_SHARE: f64 = 0.5;

/// The initial hypothesis: the pencil's sources, or the residual peaks of one round, with a background where one is visible. Good
/// enough to find isolated outliers in the residual.
pub(crate) fn initial_hypothesis(search: &mut Search) -> Hypothesis {
    if search.pencil.is_some() {
        return initialise(search, Nuisances::default(), PENCIL_FIT_STEPS).into_hypothesis();
    }
    let mut candidate = Candidate::from(Hypothesis::empty(Nuisances {
        background: search.visible_background(),
        width: Width::Known,
    }));
    let peaks = search.residual_peaks(&mut candidate);
    let most = search.compressed().max_sources();
    search.context.budget.is_limited |= peaks.len() > most;
    candidate.sources = strong_sources(&peaks, most).collect();
    search.fit_trial(&mut candidate);
    candidate.into_hypothesis()
}

/// A hypothesis from the pencil where spots overlap, from residual peaks elsewhere. `steps` of a fit from each of the pencil's counts.
pub(crate) fn initialise(search: &mut Search, nuisances: Nuisances, steps: usize) -> Candidate {
    if let Some(found) = initialise_by_pencil(search, nuisances, steps) {
        return found;
    }
    let mut dark = Candidate::from(Hypothesis::empty(nuisances));
    search.fit_trial(&mut dark);
    add_residual_peaks(search, dark)
}

/// The strongest peaks as sources, at most `most`.
fn strong_sources(peaks: &[Peak], most: usize) -> impl Iterator<Item = PointSource> {
    let least = peaks.first().map_or(0.0, |p| STRONG_PEAK * p.significance);
    peaks
        .iter()
        .take_while(move |p| p.significance >= least)
        .take(most)
        .map(|p| PointSource::new(p.u, p.a))
}

/// Adds peaks of the residual to `candidate` until none is significant, refitting all emitters each time. Sets the search's suspected
/// variance.
pub(crate) fn add_residual_peaks(search: &mut Search, mut candidate: Candidate) -> Candidate {
    let most = search.compressed().max_sources();
    while candidate.sources.len() < most && (candidate.sources.is_empty() || !search.is_explained_by(&candidate)) {
        let peaks = search.residual_peaks(&mut candidate);
        search.context.budget.is_limited |= candidate.sources.len() + peaks.len() > most;
        let mut next = candidate.clone();
        next.sources
            .extend(strong_sources(&peaks, most - candidate.sources.len()));
        if next.sources.len() == candidate.sources.len() {
            break;
        }
        search.fit_trial(&mut next);
        // Apparent sources may be a background or another width: the better score decides.
        if !search.is_explained_by(&next) || next.sources.len() > candidate.sources.len() + ACCEPTED_EXTRA {
            let wider = with_more_nuisances(search, &candidate, &next);
            if let Some(wider) = wider.filter(|w| search.score(w) < search.score(&next)) {
                next = wider;
            }
        }
        if !search.is_explained_by(&next) {
            search.suspected_variance = test_variance_growth(search, &mut candidate, &next);
        }
        if search.suspected_variance.is_some() || search.score(&next) > search.score(&candidate) {
            break;
        }
        candidate = next;
        if search.is_exhausted() {
            break;
        }
    }
    candidate
}

/// Fits the pencil's positions for rising numbers of sources until the frame is explained; `None` without a pencil.
fn initialise_by_pencil(search: &mut Search, nuisances: Nuisances, steps: usize) -> Option<Candidate> {
    if search.is_heavily_masked() {
        return None;
    }
    let (compressed, bases) = (search.compressed(), search.context.bases);
    let pencil = search.pencil.as_mut()?.analyse(compressed, &bases.x, &bases.y)?;
    let sure = pencil.singular_value_ratio.iter().take_while(|&&s| s > 4.0).count();
    let likely = pencil.singular_value_ratio.iter().take_while(|&&s| s > 0.5).count();
    let last = (likely + 2).min(pencil.most()).min(compressed.max_sources());
    let mut best = Candidate::from(Hypothesis::empty(nuisances));
    search.fit_trial(&mut best);
    // A background and another width have singular values of their own.
    let is_plain = nuisances == Nuisances::default();
    let (first, beyond) = if is_plain { (sure, 2) } else { (sure / 3, 3) };
    let counts = first.max(1)..=last.min(sure.max(3) + beyond);
    fit_pencil_orders(search, &pencil, &mut best, counts, steps);
    Some(best)
}

/// Fits the pencil's positions for each count until `best`, which keeps the better score, explains the frame.
fn fit_pencil_orders(
    search: &mut Search,
    pencil: &MatrixPencil,
    best: &mut Candidate,
    counts: RangeInclusive<usize>,
    steps: usize,
) {
    let nuisances = best.nuisances;
    let patience = if nuisances == Nuisances::default() { 1 } else { 3 };
    let mut worse = 0;
    for count in counts {
        if search.is_explained_by(best) || worse == patience || !best.sources.is_empty() && search.is_exhausted() {
            break;
        }
        let Some(seeds) = pencil.seeds(count) else { break };
        let mut hypothesis = Hypothesis::empty(nuisances);
        hypothesis
            .sources
            .extend(seeds.into_iter().map(|u| PointSource::new(u, 0.0)));
        fit(&mut search.context, &mut hypothesis, steps);
        if search.score(&hypothesis) < search.score(best) {
            *best = hypothesis.into();
            worse = 0;
        } else {
            worse += 1;
        }
    }
}

/// The variance function, where it explains the frame better than `rival` does; only in the pixel bases.
fn test_variance_growth(
    search: &mut Search,
    candidate: &mut Candidate,
    rival: &Hypothesis,
) -> Option<VarianceFunction> {
    let (compressed, frame) = (search.compressed(), search.frame);
    let is_even = search.context.bases.are_pixels() && compressed.weights.is_empty();
    if !search.rules().reweighting || !is_even || rival.deviance < RIVAL_SHARE * candidate.deviance {
        return None;
    }
    let evaluation = candidate.evaluation(&mut search.context);
    let (residual, signal) = (evaluation.residual.clone(), evaluation.expected_light());
    let variance = VarianceFunction::fit(
        &frame.is_masked,
        [compressed.rank[0], compressed.mx],
        &residual,
        &signal,
        candidate.sources.len(),
    );
    let nx = search.context.bases.x.n;
    let cost: f64 = (0..frame.is_masked.len())
        .filter(|&k| !frame.is_masked[k])
        .map(|k| k / nx * compressed.mx + k % nx)
        .map(|k| variance.at(signal[k]).ln() + residual[k].powi(2) / variance.at(signal[k]))
        .sum();
    let score = search.score(candidate) - candidate.deviance + cost + VarianceFunction::PENALTY;
    (score < search.score(rival)).then_some(variance)
}

/// The matched filter's maxima as sources.
pub(crate) fn filter_peaks(search: &mut Search) -> Hypothesis {
    let compressed = search.compressed();
    let peaks = search.matched_filter.peaks(
        &compressed.coefficients,
        compressed.mx,
        compressed.my,
        search.criterion.source_penalty.sqrt(),
        1.0,
    );
    search.context.budget.is_limited |= peaks.len() > MOST_PEAKS;
    let strongest = peaks.iter().take(MOST_PEAKS);
    Hypothesis {
        sources: strongest.map(|p| PointSource::new(p.u, p.a)).collect(),
        ..Hypothesis::empty(Nuisances::default())
    }
}
