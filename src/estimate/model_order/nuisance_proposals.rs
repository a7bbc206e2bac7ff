//! Proposals that change the nuisances of a hypothesis: more of them, or none.

use crate::estimate::model::hypothesis::{Background, Hypothesis, Nuisances, Width};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::search::Search;

/// `hypothesis` with the further nuisances that score best, if any score better; fits that cannot beat `rival` are aborted.
pub(crate) fn with_more_nuisances(
    search: &mut Search,
    hypothesis: &Hypothesis,
    rival: &Hypothesis,
) -> Option<Candidate> {
    if hypothesis.sources.is_empty() {
        return None;
    }
    let mut best: Option<Hypothesis> = None;
    let lit = search.with_background(Width::Known);
    for width in [Width::Known, Width::Common, Width::PerAxis] {
        let nuisances = Nuisances { width, ..lit };
        if nuisances.count() <= hypothesis.nuisances.count() || search.is_measured() && width != Width::Known {
            continue;
        }
        let mut next = best.as_ref().unwrap_or(hypothesis).clone();
        next.nuisances = nuisances;
        search.fit_against(rival, &mut next);
        if search.score(&next) < search.score(best.as_ref().unwrap_or(hypothesis)) {
            let is_explained = search.is_explained_by(&next);
            best = Some(next);
            if is_explained {
                break;
            }
        }
    }
    best.map(Candidate::from)
}

/// Removes nuisances where the score improves without them.
pub(crate) fn drop_nuisances(search: &mut Search, candidate: &mut Candidate) {
    let Nuisances { background, width } = candidate.nuisances;
    let simpler = [
        (background, Width::Known),
        (Background::Plane, width),
        (Background::None, width),
        (Background::None, Width::Known),
    ]
    .map(|(background, width)| Nuisances { background, width });
    for nuisances in simpler {
        if nuisances.background <= candidate.nuisances.background && nuisances.count() < candidate.nuisances.count() {
            let mut next = Hypothesis::clone(candidate);
            next.restrict_nuisances(nuisances);
            search.try_accept(candidate, next);
        }
    }
}
