//! Nuisance selection: a background, another width or a rotated ellipse may explain a frame better than more emitters.

use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::model::hypothesis::{Hypothesis, Width};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::initialise::initialise;
use crate::estimate::model_order::nuisance_proposals::with_more_nuisances;
use crate::estimate::model_order::proposals::{disjoint_close_pairs, merge_pairs};
use crate::estimate::model_order::refine::{refine, shrink};
use crate::estimate::model_order::search::Search;

/// Rounds of proposals, and rounds before nuisances are tried; both end as soon as a round gains nothing.
pub(crate) const ROUNDS: usize = 8;
pub(crate) const EARLY_ROUNDS: usize = 3;
/// Ratio of energies from which overlapping sources may be an artefact of a wrong width or background. Users' energies scatter by a tenth;
/// smaller would test nuisances in frames of honest users of two powers, which only costs time.
const MAX_ENERGY_RATIO: f64 = 3.0;
/// Rotated ellipses: shares of a frame's work before and after they have reduced the excess deviance to `ELLIPSE_GAIN` of it. The trial is
/// paid by every frame that nothing explains.
const ELLIPSE_TRIAL_WORK: f64 = 0.2;
const ELLIPSE_WORK: f64 = 0.7;
const ELLIPSE_GAIN: f64 = 0.02;
/// Sources within this distance, σ, may be one source with an elliptical PSF: a plain fit puts a pair in the place of a spot 5 % longer
/// than wide; users so near each other are rare where spots stand apart.
pub(crate) const CLOSE_PAIR_DISTANCE: f64 = 1.5;
/// Spots that tell another width from a pair, and the decrease of the deviance for each of its parameters by which they do, the pairs left as they are:
/// where no spot is wider, one in 600 frames has it. More makes pairs of wide spots, less hides strangers beside users.
const LEAST_SPOTS: usize = 3;
const SHOWN_BESIDE: f64 = 10.0;
/// Wald statistic, in source penalties, below which a source may be an artefact of a background or a width; larger costs a fit with
/// nuisances in more frames.
const DOUBTFUL: f64 = 4.0;
/// Steps of a fit from the pencil's positions with nuisances: the pencil knows nothing of a width and starts farther off.
const NUISANCE_FIT_STEPS: usize = 150;

/// Tries a background, another width, or both instead of more emitters and keeps what scores better than `candidate`.
pub(crate) fn select_nuisances(search: &mut Search, candidate: &mut Candidate) {
    let with_width = search.with_background(Width::Common);
    if candidate.nuisances == with_width && is_settled(search, candidate) {
        return;
    }
    let lit = search.with_background(Width::Known);
    // A background has singular values of its own, which the pencil would count as emitters.
    let grown = if search.pencil.is_some() {
        let mut grown = Candidate::from(Hypothesis::empty(lit));
        search.fit_trial(&mut grown);
        refine(search, &mut grown, ROUNDS);
        grown
    } else {
        initialise(search, lit, NUISANCE_FIT_STEPS)
    };
    search.keep_better(candidate, grown);
    if is_settled(search, candidate) {
        let mut next = candidate.clone();
        next.nuisances = with_width;
        search.fit_trial(&mut next);
        refine(search, &mut next, EARLY_ROUNDS);
        search.keep_better(candidate, next);
    }
    if !is_settled(search, candidate) {
        let next = initialise(search, with_width, NUISANCE_FIT_STEPS);
        search.keep_better(candidate, next);
    }
    if !search.is_explained_by(candidate)
        && let Some(wider) = with_more_nuisances(search, candidate, candidate)
    {
        *candidate = wider;
    }
}

/// Whether a hypothesis explains the frame by sources of about the same energy.
fn is_settled(search: &Search, hypothesis: &Hypothesis) -> bool {
    search.is_explained_by(hypothesis) && !has_unequal_energies(search, hypothesis)
}

/// Whether a background and another width can replace sources of a hypothesis that explains the frame.
pub(crate) fn nuisances_can_replace_sources(search: &mut Search, candidate: &Candidate) -> bool {
    let mut next = candidate.clone();
    next.nuisances = search.with_background(Width::Common);
    search.fit_trial(&mut next);
    let least = DOUBTFUL * search.criterion.source_penalty;
    let significance = next.wald_statistics(&mut search.context);
    if significance.iter().filter(|s| **s < least).count() < 2 {
        return false;
    }
    shrink(search, &mut next);
    search.score(&next) < search.score(candidate)
}

/// Tries a rotated elliptical PSF: from `candidate` with close pairs merged, or where spots overlap from the `first` hypothesis and
/// from the pencil's positions.
pub(crate) fn try_rotated_ellipse(search: &mut Search, first: Hypothesis, candidate: &mut Candidate) {
    if candidate.sources.is_empty() || search.is_heavily_masked() {
        return;
    }
    let data_count = search.compressed().data_count;
    let is_overlapping = search.pencil.is_some();
    let mut next = Candidate::from(if is_overlapping {
        first
    } else {
        merge_pairs(candidate, &disjoint_close_pairs(candidate, CLOSE_PAIR_DISTANCE))
    });
    next.nuisances = search.with_background(Width::Common);
    search.fit_trial(&mut next);
    if search.is_explained_by(&next) {
        return search.keep_better(candidate, next);
    }
    let left = next.deviance - data_count;
    next.nuisances = search.with_background(Width::RotatedEllipse);
    let limit = search.context.budget.limit(ELLIPSE_TRIAL_WORK);
    search.fit_trial(&mut next);
    search.context.budget.restore_limit(limit);
    if !search.is_explained_by(&next) && next.deviance - data_count > ELLIPSE_GAIN * left {
        return;
    }
    search.context.budget.limit(ELLIPSE_WORK);
    fit(&mut search.context, &mut next, NUISANCE_FIT_STEPS);
    if search.is_explained_by(&next) {
        refine(search, &mut next, EARLY_ROUNDS);
    }
    search.keep_better(candidate, next);
    if is_overlapping && !is_settled(search, candidate) {
        let ellipse = search.with_background(Width::RotatedEllipse);
        let next = initialise(search, ellipse, NUISANCE_FIT_STEPS);
        search.keep_better(candidate, next);
    }
    search.context.budget.restore_limit(limit);
}

/// Another width or an elongated spot in the place of close pairs, if that is likelier and the spots beside the pairs show it too. Spots that are a
/// little wider than the PSF show it first in the brightest, which two sources explain as well.
pub(crate) fn try_width_for_pairs(search: &mut Search, candidate: &mut Candidate) {
    let pairs = disjoint_close_pairs(candidate, CLOSE_PAIR_DISTANCE);
    if pairs.is_empty() || candidate.sources.len() < LEAST_SPOTS + pairs.len() {
        return;
    }
    let paired = candidate.clone();
    let merged = merge_pairs(candidate, &pairs);
    for width in [Width::Common, Width::PerAxis, Width::RotatedEllipse] {
        let mut beside = paired.clone();
        beside.nuisances.width = width;
        search.fit_trial(&mut beside);
        let needed = SHOWN_BESIDE * search.criterion.noise_inflation * beside.nuisances.count() as f64;
        if paired.deviance - beside.deviance > needed {
            let mut next = merged.clone();
            next.nuisances.width = width;
            search.try_accept(candidate, next);
        }
    }
}

/// Whether overlapping sources differ so much in energy that some may be an artefact of a background or another width.
pub(crate) fn has_unequal_energies(search: &Search, hypothesis: &Hypothesis) -> bool {
    let energies = hypothesis.sources.iter().map(|s| s.a);
    let [least, most] = [
        energies.clone().fold(f64::INFINITY, f64::min),
        energies.fold(0.0, f64::max),
    ];
    search.pencil.is_some() && most > MAX_ENERGY_RATIO * least
}

/// Whether so many sources come in close pairs that an elliptical PSF may be the cause.
pub(crate) fn has_paired_sources(hypothesis: &Hypothesis) -> bool {
    let pairs = disjoint_close_pairs(hypothesis, CLOSE_PAIR_DISTANCE).len();
    pairs > 1 && 4 * pairs >= hypothesis.sources.len()
}
