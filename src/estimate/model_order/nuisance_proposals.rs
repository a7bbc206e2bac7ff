//! Proposals that change the nuisances of a hypothesis: more of them, or none.

use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, Width};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::search::Search;

/// The nuisances tried in the place of more emitters.
pub(crate) const BACKGROUND_AND_WIDTH: Nuisances = Nuisances {
    background: true,
    width: Width::Common,
};

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
    for width in [Width::Known, Width::Common, Width::PerAxis] {
        let nuisances = Nuisances {
            background: true,
            width,
        };
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
    let simpler = [
        Nuisances {
            background: candidate.nuisances.background,
            width: Width::Known,
        },
        Nuisances {
            background: false,
            width: candidate.nuisances.width,
        },
        Nuisances::default(),
    ];
    for nuisances in simpler {
        if nuisances.count() < candidate.nuisances.count() {
            let mut next = Hypothesis::clone(candidate);
            next.restrict_nuisances(nuisances);
            search.try_accept(candidate, next);
        }
    }
}
