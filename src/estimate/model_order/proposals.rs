//! Proposals that change the number of sources: birth, split, merge, death, relocation inside. Each tries its hypotheses in turn and returns
//! whether one was accepted.

use crate::estimate::detect::matched_filter::Peak;
use crate::estimate::model::hypothesis::{Hypothesis, OVERLAPPING, PointSource};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::search::Search;
use crate::estimate::uncertainty::split_score_test::SplitProposal;

/// Peaks and splits that a birth and a split try, the most promising first: each costs a fit, and the next round tries anew.
const MAX_BIRTHS: usize = 2;
const MAX_SPLITS: usize = 3;
/// Merges proposed in a round, the nearest pairs first.
const MAX_MERGES: usize = 3;
/// Within this distance, σ, the quadratic prediction of a merge is unreliable and ignored: the covariance of such a pair is rounding's.
const UNRELIABLE_DISTANCE: f64 = 0.15;
/// Predicted rise of the deviance, in source penalties, beyond which a merge is not tried: far above 1, since damping hides
/// narrow valleys from the prediction (P1/64).
const HOPELESS_MERGE: f64 = 8.0;
/// Distance from the edge, σ, of a source that is relocated inside: nearer, the fit leads it back out.
const INSET: f64 = 1.0;
/// Removal candidates, the faintest first, when an off-sensor source moves inside; each costs a fit.
const REMOVAL_CANDIDATES: usize = 3;
/// Deaths proposed in a round, and Wald's statistic, in source penalties, below which a source may be removed: other sources take up a part
/// of its light, so that the deviance rises by less than the statistic of a lone one predicts.
const MAX_DEATHS: usize = 6;
const MORTAL: f64 = 4.0;
/// Predicted gain, in source penalties, from which a split is proposed though the frame is explained: the second-order prediction is some
/// 20 % off (see its test), and a gain below the penalty is rejected after the fit.
const LIKELY_SPLIT: f64 = 0.6;
/// Least and largest distance of a split's halves from the source, σ: nearer, they are no two sources to the fit; the score sees only the
/// second moment, which says little beyond.
const SPLIT_DISTANCE: [f64; 2] = [0.4, 1.0];

/// A source at a residual peak.
pub(crate) fn birth(search: &mut Search, candidate: &mut Candidate, peaks: &[Peak]) -> bool {
    search.rules().birth
        && peaks.iter().take(MAX_BIRTHS).any(|peak| {
            let mut next = Hypothesis::clone(candidate);
            next.sources.push(PointSource::new(peak.u, peak.a));
            search.try_accept(candidate, next)
        })
}

/// Two halves in the place of a source, where the score test predicts a gain.
pub(crate) fn split(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().split {
        return false;
    }
    let splits = candidate.split_proposals(&mut search.context);
    let least = match search.is_explained_by(candidate) {
        true => LIKELY_SPLIT * search.criterion.threshold(),
        false => f64::NEG_INFINITY,
    };
    splits.iter().take(MAX_SPLITS).take_while(|s| s.gain > least).any(|s| {
        let next = split_source(candidate, s);
        search.try_accept(candidate, next)
    })
}

/// Two halves in the place of every source that the score test takes for two, all at once: where there is no pencil to begin with, a melted pair
/// would otherwise be found by the peaks that one source in its place leaves on either side.
pub(crate) fn split_all(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().split {
        return false;
    }
    let splits = candidate.split_proposals(&mut search.context);
    let least = search.criterion.threshold();
    let likely = splits.iter().take_while(|s| s.gain > least);
    let next = likely.fold(Hypothesis::clone(candidate), |next, s| split_source(&next, s));
    next.sources.len() > candidate.sources.len() && search.try_accept(candidate, next)
}

/// One source in the place of a close pair, where the quadratic prediction leaves hope.
pub(crate) fn merge(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().merge {
        return false;
    }
    let pairs = close_pairs(candidate, OVERLAPPING);
    pairs.into_iter().take(MAX_MERGES).any(|(d, i, j)| {
        if d > UNRELIABLE_DISTANCE
            && candidate.merge_deviance_rise(&mut search.context, i, j) > HOPELESS_MERGE * search.criterion.threshold()
        {
            return false;
        }
        let next = merge_pairs(candidate, &[(i, j)]);
        search.try_accept(candidate, next)
    })
}

/// All unresolved pairs merged at once, where there are several.
pub(crate) fn merge_all(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().merge_all {
        return false;
    }
    let mut chosen: Vec<(usize, usize)> = Vec::new();
    for (_, i, j) in close_pairs(candidate, OVERLAPPING) {
        if is_disjoint(&chosen, i, j)
            && candidate.merge_deviance_rise(&mut search.context, i, j) < search.criterion.threshold()
        {
            chosen.push((i, j));
        }
    }
    if chosen.len() < 2 {
        return false;
    }
    let next = merge_pairs(candidate, &chosen);
    search.try_accept(candidate, next)
}

/// A faint source is removed: the least significant may be one of an unresolved pair, and needed, so several are tried.
pub(crate) fn death(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().death {
        return false;
    }
    let significance = candidate.wald_statistics(&mut search.context);
    let mut mortal: Vec<usize> = (0..significance.len()).collect();
    mortal.retain(|&i| significance[i] < MORTAL * search.criterion.threshold());
    mortal.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
    mortal.into_iter().take(MAX_DEATHS).any(|index| {
        let mut next = Hypothesis::clone(candidate);
        next.sources.remove(index);
        search.try_accept(candidate, next)
    })
}

/// A source is removed and one beyond the sensor's edge moves inside: two sources at the edge may fit the tail of one that the edge cuts.
pub(crate) fn relocate_inside(search: &mut Search, candidate: &mut Candidate) -> bool {
    if !search.rules().relocate_inside || !search.is_explained_by(candidate) {
        return false;
    }
    let ends = search.context.bases.axes().map(|b| [b.edges[0], b.edges[b.n]]);
    let is_outside = |u: [f64; 2]| (0..2).any(|k| !(ends[k][0]..=ends[k][1]).contains(&u[k]));
    let outside: Vec<usize> = (0..candidate.sources.len())
        .filter(|&i| is_outside(candidate.sources[i].u))
        .collect();
    let mut spare = faintest(candidate);
    spare.truncate(REMOVAL_CANDIDATES);
    spare.extend(&outside);
    outside.iter().any(|&k| {
        spare.iter().filter(|&&i| i != k).any(|&i| {
            let mut next = Hypothesis::clone(candidate);
            for (u, [low, high]) in next.sources[k].u.iter_mut().zip(ends) {
                let inside = INSET.min(0.5 * (high - low));
                *u = u.max(low + inside).min(high - inside);
            }
            next.sources.remove(i);
            search.try_accept(candidate, next)
        })
    })
}

/// Indices of the sources, the faintest first.
fn faintest(hypothesis: &Hypothesis) -> Vec<usize> {
    let mut order: Vec<usize> = (0..hypothesis.sources.len()).collect();
    order.sort_by(|&i, &j| hypothesis.sources[i].a.total_cmp(&hypothesis.sources[j].a));
    order
}

/// `hypothesis` with a source replaced by two halves on either side.
fn split_source(hypothesis: &Hypothesis, split: &SplitProposal) -> Hypothesis {
    let mut next = hypothesis.clone();
    let source = hypothesis.sources[split.index];
    let distance = split.distance.clamp(SPLIT_DISTANCE[0], SPLIT_DISTANCE[1]);
    let half = |sign: f64| {
        let u = [0, 1].map(|k| source.u[k] + sign * distance * split.direction[k]);
        PointSource::new(u, 0.5 * source.a)
    };
    next.sources[split.index] = half(1.0);
    next.sources.push(half(-1.0));
    next
}

/// Pairs of sources nearer than `limit`, σ, with their distance; the nearest first.
pub(crate) fn close_pairs(hypothesis: &Hypothesis, limit: f64) -> Vec<(f64, usize, usize)> {
    let n = hypothesis.sources.len();
    let mut pairs: Vec<(f64, usize, usize)> = (0..n)
        .flat_map(|i| (0..i).map(move |j| (i, j)))
        .map(|(i, j)| {
            let d = [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k]);
            (d[0].hypot(d[1]), i, j)
        })
        .filter(|p| p.0 < limit)
        .collect();
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
}

/// Pairs of sources nearer than `limit`, σ, the nearest first, each source in at most one.
pub(crate) fn disjoint_close_pairs(hypothesis: &Hypothesis, limit: f64) -> Vec<(usize, usize)> {
    let mut chosen: Vec<(usize, usize)> = Vec::new();
    for (_, i, j) in close_pairs(hypothesis, limit) {
        if is_disjoint(&chosen, i, j) {
            chosen.push((i, j));
        }
    }
    chosen
}

fn is_disjoint(chosen: &[(usize, usize)], i: usize, j: usize) -> bool {
    chosen
        .iter()
        .all(|&(a, b)| ![a, b].contains(&i) && ![a, b].contains(&j))
}

/// `hypothesis` with source j < i of each pair moved to the pair's centroid with its total energy, and without i.
pub(crate) fn merge_pairs(hypothesis: &Hypothesis, pairs: &[(usize, usize)]) -> Hypothesis {
    let mut next = hypothesis.clone();
    for &(i, j) in pairs {
        let (p, q) = (hypothesis.sources[i], hypothesis.sources[j]);
        let total = p.a + q.a;
        next.sources[j] = PointSource::new([0, 1].map(|k| (p.a * p.u[k] + q.a * q.u[k]) / total), total);
    }
    let mut k = 0;
    next.sources.retain(|_| {
        k += 1;
        pairs.iter().all(|&(i, _)| i != k - 1)
    });
    next
}
