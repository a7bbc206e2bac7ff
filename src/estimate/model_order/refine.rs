//! The loop over the proposals: each round grows the hypothesis, then shrinks it, until neither improves the score.

use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::proposals::{birth, death, merge, merge_all, relocate_inside, split};
use crate::estimate::model_order::search::Search;

/// Rounds go on while they improve the score by this much.
pub(crate) const LEAST_GAIN: f64 = 0.1;

/// Applies proposals to `candidate` until none improves the score, then fits to convergence.
pub(crate) fn refine(search: &mut Search, candidate: &mut Candidate, rounds: usize) {
    for _ in 0..rounds {
        let before = search.score(candidate);
        if !search.is_explained_by(candidate) {
            search.converge(candidate);
        }
        grow(search, candidate);
        shrink(search, candidate);
        if before - search.score(candidate) < LEAST_GAIN || search.is_exhausted() {
            break;
        }
    }
    search.converge(candidate);
}

/// Proposes births and splits, each once.
pub(crate) fn grow(search: &mut Search, candidate: &mut Candidate) {
    let peaks = search.residual_peaks(candidate);
    birth(search, candidate, &peaks);
    split(search, candidate);
}

/// Proposes merges, deaths and relocations inside while one is accepted.
pub(crate) fn shrink(search: &mut Search, candidate: &mut Candidate) {
    while merge_all(search, candidate) {}
    while merge(search, candidate) || death(search, candidate) || relocate_inside(search, candidate) {}
}
