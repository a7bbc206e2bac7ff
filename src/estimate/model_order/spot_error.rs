//! The search where spots may differ from the PSF: every pixel's variance is raised by the spots' halo, so that no hypothesis explains a
//! lens's rings, tails and ghosts by emitters, and by their shot noise where that is known.

use crate::estimate::fit::levenberg_marquardt::evaluate;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::halo::{ErrorByDistance, Halo, height, spot_norm};
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource, Width};
use crate::estimate::model_order::bright_spots::{CORE, are_pairs_alike, bright_spots, distance2, is_faint_beside};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::common_misfit::{Agreement, MAX_SPOT_ERROR, common_misfit};
use crate::estimate::model_order::maximum_likelihood::refit_reweighted;
use crate::estimate::model_order::proposals::split_all;
use crate::estimate::model_order::pruning::drop_insignificant;
use crate::estimate::model_order::search::{Search, SearchSpace};
use crate::estimate::preprocess::screening::PreprocessedFrame;

/// Rounds of splitting sources or adding residual peaks, each under weights that follow the sources found so far.
const PASSES: usize = 6;
/// Rounds of proposals under the last weights.
const ROUNDS: usize = 3;
/// Peaks below this share of the highest one wait for the next round, whose weights allow for the brighter ones' halo.
const STRONG_PEAK: f64 = 0.1;
/// Peaks of the frame above this share of the highest one are taken for spots of their own: higher than any ring or tail.
const HIGH_PEAK: f64 = 0.2;
/// Spots from which what stands beside them may be a lens's though sources explain it: a single pair is two sources. Also where sources
/// explain all but an excess of [`CHANCE`]: chance leaves one of some hundred frames unexplained, and two melted spots always have
/// something in common.
const LEAST_SPOTS: usize = 3;
const CHANCE: f64 = 5.0;
/// Share of the variance that the halo of other spots adds to a position: their misfit is smooth across a spot, while the weights must hold
/// at its worst place. Found from Airy discs at SNR 1000, the kind of spot whose positions others move most.
const POSITION_SHARE: f64 = 0.1;

/// What a frame shows of its spots' shape.
pub(crate) enum Shape {
    /// Nothing that the PSF does not explain.
    AsModelled,
    /// Fewer sources explain the frame with equal weights.
    Simpler(Hypothesis),
    /// The spots differ from the PSF by this share of their light; the bright ones.
    Different(f64, Hypothesis),
}

/// The bright spots of `hypothesis` that are not the halo of emitters `beyond` the frame.
pub(crate) fn without_halo_of(beyond: &[PointSource], hypothesis: &Hypothesis) -> Hypothesis {
    let mut sources = bright_spots(hypothesis, false);
    sources.retain(|source| !beyond.iter().any(|head| is_faint_beside(source, head)));
    Hypothesis {
        sources,
        converged: false,
        ..hypothesis.clone()
    }
}

/// Compares the residuals around the bright spots of `hypothesis`, whose deviance has this excess. Where it explains the frame, that stands unless its sources are
/// arranged as a lens's misfit is.
pub(crate) fn inspect_shape(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    hypothesis: &Hypothesis,
    excess: f64,
    budget: &mut WorkBudget,
) -> Shape {
    let is_explained = excess < compressed.most_excess();
    let is_narrow = space.bases.is_narrow();
    let has_width = hypothesis.nuisances.width != Width::Known;
    let is_elongated = has_width || may_be_elongated(space, hypothesis);
    let (merged, separate) = (bright_spots(hypothesis, true), bright_spots(hypothesis, false));
    let mut alternatives = match is_explained {
        false => vec![merged, separate],
        true if is_elongated => vec![merged],
        true if (!is_narrow || separate.len() >= LEAST_SPOTS) && separate.len() < hypothesis.sources.len() => {
            vec![separate]
        }
        true => return Shape::AsModelled,
    };
    compressed.load(frame, &space.bases.x, &space.bases.y);
    let mut search = space.search(compressed, frame, budget);
    if !is_explained {
        alternatives.insert(0, highest_peaks(&mut search, hypothesis));
    }
    for sources in alternatives {
        let mut candidate = Candidate::from(Hypothesis {
            sources,
            converged: false,
            ..hypothesis.clone()
        });
        search.fit_trial(&mut candidate);
        if search.is_explained_by(&candidate) {
            let mut rival = Candidate::from(hypothesis.clone());
            search.fit_trial(&mut rival);
            if search.score(&candidate) < search.score(&rival) {
                return Shape::Simpler(candidate.into_hypothesis());
            }
        }
        let least = if excess < CHANCE && (!has_width || is_narrow) {
            LEAST_SPOTS
        } else {
            1
        };
        let error = common_misfit(&mut search, &mut candidate, least, is_explained, Agreement::ALONE);
        if error > 0.0 {
            return Shape::Different(error, candidate.into_hypothesis());
        }
    }
    Shape::AsModelled
}

/// Whether pairs of sources may be the elongated spots of a lens that nobody has measured.
fn may_be_elongated(space: &SearchSpace, hypothesis: &Hypothesis) -> bool {
    space.bases.shape.is_none() && are_pairs_alike(hypothesis)
}

/// The bright spots of `hypothesis` with another width, or elongated, where that explains the frame. Asked before spots are compared: those of
/// another width have that in common.
pub(crate) fn explained_by_width(search: &mut Search, hypothesis: &Hypothesis) -> Option<Hypothesis> {
    if search.is_measured() || !search.rules().explain_by_width {
        return None;
    }
    [true, false].into_iter().find_map(|merge_core| {
        let mut candidate = Candidate::from(Hypothesis {
            sources: bright_spots(hypothesis, merge_core),
            converged: false,
            ..hypothesis.clone()
        });
        [Width::Common, Width::RotatedEllipse].into_iter().find_map(|width| {
            candidate.nuisances = search.with_background(width);
            search.fit_trial(&mut candidate);
            search
                .is_explained_by(&candidate)
                .then(|| candidate.clone().into_hypothesis())
        })
    })
}

/// The highest peaks of the frame, as many as a hypothesis may have, whatever one made of it.
fn highest_peaks(search: &mut Search, hypothesis: &Hypothesis) -> Vec<PointSource> {
    let mut dark = Candidate::from(Hypothesis::empty(Nuisances {
        background: hypothesis.nuisances.background,
        width: Width::Known,
    }));
    search.fit_trial(&mut dark);
    let peaks = search.residual_peaks(&mut dark);
    let least = peaks.first().map_or(0.0, |p| HIGH_PEAK * p.significance);
    let high = peaks.iter().take_while(|p| p.significance >= least);
    let most = search.compressed().max_sources();
    high.take(most).map(|p| PointSource::new(p.u, p.a)).collect()
}

/// The bright spots of a frame that `hypothesis` explains by a width and faint sources, and the spot error that they show, where a lens
/// explains it as well.
pub(crate) fn try_spot_error(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    hypothesis: &Hypothesis,
    budget: &mut WorkBudget,
) -> Option<(f64, Hypothesis)> {
    if bright_spots(hypothesis, false).len() == hypothesis.sources.len() && !may_be_elongated(space, hypothesis) {
        return None;
    }
    compressed.load(frame, &space.bases.x, &space.bases.y);
    let sources = highest_peaks(&mut space.search(compressed, frame, budget), hypothesis);
    let start = Hypothesis {
        sources,
        ..with_known_width(hypothesis)
    };
    let spots = search_with_spot_error(space, compressed, frame, MAX_SPOT_ERROR, start, budget);
    let error = shown_spot_error(space, compressed, frame, &spots, true, budget);
    (error > 0.0).then_some((error, spots))
}

/// The spot error that a frame shows around the sources of `hypothesis`; 0 where they explain it under equal weights. `is_explained`:
/// whether more sources explain the frame.
pub(crate) fn shown_spot_error(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    hypothesis: &Hypothesis,
    is_explained: bool,
    budget: &mut WorkBudget,
) -> f64 {
    compressed.load(frame, &space.bases.x, &space.bases.y);
    let mut search = space.search(compressed, frame, budget);
    let mut candidate = Candidate::from(with_known_width(hypothesis));
    search.fit_trial(&mut candidate);
    if search.is_explained_by(&candidate) {
        return 0.0;
    }
    let least = if is_explained { LEAST_SPOTS } else { 1 };
    common_misfit(&mut search, &mut candidate, least, is_explained, Agreement::OF_FRAMES)
}

/// The hypothesis with spots of the known width, to be fitted.
pub(crate) fn with_known_width(hypothesis: &Hypothesis) -> Hypothesis {
    Hypothesis {
        nuisances: Nuisances {
            width: Width::Known,
            ..hypothesis.nuisances
        },
        converged: false,
        ..hypothesis.clone()
    }
}

/// Searches from `start` under the weights of a spot error; leaves them in `compressed`.
pub(crate) fn search_with_spot_error(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    spot_error: f64,
    start: Hypothesis,
    budget: &mut WorkBudget,
) -> Hypothesis {
    compressed.load(frame, &space.bases.x, &space.bases.y);
    let most = compressed.max_sources();
    let bright = start.sources.clone();
    let mut candidate = Candidate::from(start);
    for _ in 0..PASSES {
        set_weights(space, compressed, frame, spot_error, &candidate);
        let mut search = space.search(compressed, frame, budget);
        search.fit_trial(&mut candidate);
        if split_all(&mut search, &mut candidate) {
            continue;
        }
        let peaks = search.residual_peaks(&mut candidate);
        let least = peaks.first().map_or(0.0, |p| STRONG_PEAK * p.significance);
        let threshold = search.criterion.threshold().sqrt();
        let room = most.saturating_sub(candidate.sources.len());
        let added: Vec<PointSource> = peaks
            .iter()
            .filter(|p| p.significance > threshold && p.significance >= least)
            .take(room)
            .map(|p| PointSource::new(p.u, p.a))
            .collect();
        if added.is_empty() || search.is_exhausted() {
            break;
        }
        candidate.sources.extend(added);
    }
    set_weights(space, compressed, frame, spot_error, &candidate);
    let mut search = space.search(compressed, frame, budget);
    let mut refined = Candidate::from(refit_reweighted(
        &mut search,
        candidate.clone().into_hypothesis(),
        ROUNDS,
    ));
    if search.is_exhausted() {
        // What was born last has had no death tried.
        drop_insignificant(&mut search, &mut refined);
        search.converge(&mut refined);
    }
    // A bright spot is never its own halo's.
    let is_kept = |spot: &PointSource| refined.sources.iter().any(|s| distance2(s.u, spot.u) < CORE * CORE);
    if bright.iter().all(is_kept) {
        return refined.into_hypothesis();
    }
    search.converge(&mut candidate);
    candidate.into_hypothesis()
}

/// Removes sources that do not exceed the halo of the others, the faintest first.
pub(crate) fn drop_halo(bases: &Bases, spot_error: f64, penalty: f64, sources: &mut Vec<PointSource>) {
    let (norm, error) = (spot_norm(bases), ErrorByDistance::new(bases, spot_error));
    sources.sort_by(|a, b| b.a.total_cmp(&a.a));
    let mut kept: Vec<PointSource> = Vec::with_capacity(sources.len());
    for source in sources.drain(..) {
        let part = |s: &PointSource| {
            let d2 = distance2(s.u, source.u);
            (error.at(d2) * s.a * norm * height(d2)).powi(2)
        };
        let variance: f64 = kept.iter().map(part).sum();
        if (source.a * norm).powi(2) > penalty * (1.0 + variance) {
            kept.push(source);
        }
    }
    *sources = kept;
}

/// Loads a frame with weights that allow for the halo of what was found.
pub(crate) fn load_weighted(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    spot_error: f64,
    found: &Hypothesis,
) {
    compressed.load(frame, &space.bases.x, &space.bases.y);
    set_weights(space, compressed, frame, spot_error, found);
}

/// The same unless the frame has such weights.
pub(crate) fn keep_weighted(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    spot_error: f64,
    found: &Hypothesis,
) {
    if !compressed.has_spot_error() {
        load_weighted(space, compressed, frame, spot_error, found);
    }
}

/// Weights that allow for the halo and the shot noise of what was found, and the variances that positions are reported with.
fn set_weights(
    space: &mut SearchSpace,
    compressed: &mut CompressedFrame,
    frame: &PreprocessedFrame,
    spot_error: f64,
    found: &Hypothesis,
) {
    let (nx, mx) = (space.bases.x.n, compressed.mx);
    let at = |k: usize| k / nx * mx + k % nx;
    let light = match frame.variance.is_constant() {
        true => None,
        false => Some(light_of_sources(space, compressed, frame, found)),
    };
    let noise = |k: usize| light.as_ref().map_or(1.0, |light| frame.variance.at(light[at(k)]));
    let halo = Halo::new(&space.bases, &[&found.sources, &frame.beyond[..]].concat(), spot_error);
    compressed.set_weights(frame, space.bases.axes(), |k| noise(k) + halo.variance[k]);
    let mut position_weights = compressed.weights.clone();
    for (k, others) in halo.variance_of_others.iter().enumerate() {
        let w = &mut position_weights[at(k)];
        *w = w.powi(2) * (noise(k) + POSITION_SHARE * others);
    }
    compressed.position_weights = position_weights;
}

/// The light that the sources of a hypothesis cast on the pixels, (my, mx).
fn light_of_sources(
    space: &mut SearchSpace,
    compressed: &CompressedFrame,
    frame: &PreprocessedFrame,
    hypothesis: &Hypothesis,
) -> Vec<f64> {
    let mut budget = WorkBudget::new(&|| false);
    let mut search = space.search(compressed, frame, &mut budget);
    let model = &evaluate(&mut search.context, &mut hypothesis.clone()).model;
    let mut light = vec![0.0; compressed.coefficients.len()];
    for i in 0..model.sources.len() {
        model.accumulate(i, 0, 0, model.amplitude(i), &mut light);
    }
    light
}
