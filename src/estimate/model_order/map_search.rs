//! Maximum a posteriori: number and positions of the emitters by the evidence of the frame and of known powers.

use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::model::hypothesis::{Hypothesis, INDEPENDENT, PointSource};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::evidence::fit_with_prior;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::proposals::{close_pairs, merge_pairs};
use crate::estimate::model_order::refine::{LEAST_GAIN, grow, shrink};
use crate::estimate::model_order::search::{ASSIGNMENT_SLACK, Search, TRIAL_STEPS};
use crate::estimate::uncertainty::ill_determined::{ill_determined_direction, position_covariance};

/// Rounds of proposals.
const ROUNDS: usize = 6;
/// A source of this many times a known energy is proposed to be divided.
const MIN_MULTIPLE: f64 = 1.4;
/// Least and largest spacing of a divided source's parts, σ, and most parts.
const SPACING: [f64; 2] = [0.1, 0.8];
const MAX_PARTS: usize = 4;
/// Second moment, σ², of a divided source's parts where the frame says nothing of it.
const TYPICAL_MOMENT: f64 = 1.0;
/// The total light may differ from that of one user per source by this many users before any source is proposed to be divided.
const MAX_SURPLUS: f64 = 0.4;
/// Brightest sources divided in a round, and pairs tried in a round.
const MAX_DIVISIONS: usize = 6;
const MAX_PAIRS: usize = 6;
/// Factors on the energy priors' precision, one fit each.
const TIGHTNESS: [f64; 2] = [100.0, 10.0];
/// Sources within this distance, σ, are first fitted with a tight prior.
const OVERLAP_DISTANCE: f64 = 2.0;
/// Ill-determined directions that are searched, the distances in standard deviations, and the largest distance in σ.
const DIRECTIONS: usize = 2;
const DISTANCES: [f64; 4] = [-2.0, 2.0, -5.0, 5.0];
const MAX_DISTANCE: f64 = 1.0;

/// The most probable hypothesis that proposals reach from one that explains the frame. `search` is by the evidence under `prior`.
pub(crate) fn maximum_posterior(search: &mut Search, prior: &PowerPrior, hypothesis: Hypothesis) -> Hypothesis {
    let mut candidate = Candidate::from(hypothesis);
    let threshold = f64::INFINITY;
    fit_with_prior(&mut search.context, prior, &mut candidate, TRIAL_STEPS, threshold, 0.0);
    let known = Hypothesis::clone(&candidate);
    search.try_accept(&mut candidate, known);
    let rules = search.rules();
    for _ in 0..ROUNDS {
        let before = search.score(&candidate);
        if rules.explore_ill_determined {
            explore_ill_determined(search, prior, &mut candidate);
        }
        if rules.divide {
            divide(search, prior, &mut candidate);
        }
        if rules.balance_pairs {
            balance_pair(search, prior, &mut candidate);
        }
        shrink(search, &mut candidate);
        grow(search, &mut candidate);
        if before - search.score(&candidate) < LEAST_GAIN || search.is_exhausted() {
            break;
        }
    }
    search.converge(&mut candidate);
    candidate.into_hypothesis()
}

/// Searches for a more probable optimum: with tight energy priors where sources overlap, and from positions displaced along the
/// ill-determined directions.
pub(crate) fn explore_ill_determined(search: &mut Search, prior: &PowerPrior, candidate: &mut Candidate) {
    if !close_pairs(candidate, OVERLAP_DISTANCE).is_empty() {
        fit_with_tight_prior(search, prior, candidate);
    }
    let mut places = position_covariance(&mut search.context, candidate);
    for _ in 0..DIRECTIONS {
        let Some((deviation, direction)) = ill_determined_direction(&mut places) else {
            return;
        };
        let largest = direction.iter().fold(0.0, |a: f64, d| a.max(d.abs()));
        for far in DISTANCES {
            let length = (far * deviation).clamp(-MAX_DISTANCE / largest, MAX_DISTANCE / largest);
            let mut next = Hypothesis::clone(candidate);
            for (u, d) in next.sources.iter_mut().flat_map(|s| &mut s.u).zip(&direction) {
                *u += length * d;
            }
            search.try_accept(candidate, next);
        }
    }
}

/// Refits with tight energy priors that are loosened step by step: the posterior may have several maxima, and the one nearest to the fit
/// without the prior need not be the highest.
fn fit_with_tight_prior(search: &mut Search, prior: &PowerPrior, candidate: &mut Candidate) {
    let mut next = Hypothesis::clone(candidate);
    prior.assign_components(&mut next, ASSIGNMENT_SLACK);
    for times in TIGHTNESS {
        let mut tight = next.clone();
        for power in tight.sources.iter_mut().filter_map(|s| s.power.as_mut()) {
            power.precision *= times;
        }
        fit(&mut search.context, &mut tight, TRIAL_STEPS);
        for (source, tight) in next.sources.iter_mut().zip(&tight.sources) {
            (source.u, source.a) = (tight.u, tight.a);
        }
    }
    search.try_accept(candidate, next);
}

/// Total light in excess of one user per source, in users.
fn source_surplus(prior: &PowerPrior, hypothesis: &Hypothesis) -> f64 {
    hypothesis.sources.iter().map(|s| prior.multiple(s) - 1.0).sum()
}

/// Several sources in the place of one that has the light of several users.
pub(crate) fn divide(search: &mut Search, prior: &PowerPrior, candidate: &mut Candidate) -> bool {
    let mut multiples: Vec<(f64, usize)> = candidate.sources.iter().map(|s| prior.multiple(s)).zip(0..).collect();
    multiples.sort_by(|p, q| q.0.total_cmp(&p.0));
    let least = if source_surplus(prior, candidate) > MAX_SURPLUS {
        0.0
    } else {
        MIN_MULTIPLE
    };
    multiples.retain(|b| b.0 > least);
    multiples.truncate(MAX_DIVISIONS);
    if multiples.is_empty() {
        return false;
    }
    let splits = candidate.split_proposals(&mut search.context);
    multiples.into_iter().any(|(multiple, index)| {
        let source = candidate.sources[index];
        let split = splits.iter().find(|d| d.index == index);
        let (along, moment) = split.map_or(([1.0, 0.0], 0.0), |d| (d.direction, d.distance * d.distance));
        let parts = (multiple.round() as usize).max(2);
        let across = [-along[1], along[0]];
        [(along, moment), (along, TYPICAL_MOMENT), (across, TYPICAL_MOMENT)]
            .into_iter()
            .any(|(direction, moment)| {
                let mut next = Hypothesis::clone(candidate);
                next.sources.remove(index);
                next.sources.extend(divide_source(source, parts, direction, moment));
                search.try_accept(candidate, next)
            })
    })
}

/// The light of a pair divided evenly among as many users as it is of, where one of the pair matches no known power.
pub(crate) fn balance_pair(search: &mut Search, prior: &PowerPrior, candidate: &mut Candidate) -> bool {
    let is_unassigned = |i: usize| candidate.sources[i].power.is_none();
    let pairs: Vec<(f64, usize, usize)> = close_pairs(candidate, INDEPENDENT)
        .into_iter()
        .filter(|&(_, i, j)| is_unassigned(i) || is_unassigned(j))
        .take(MAX_PAIRS)
        .collect();
    pairs.into_iter().any(|(distance, i, j)| {
        let [p, q] = [i, j].map(|k| candidate.sources[k]);
        let length = distance.max(1e-6);
        let direction = [0, 1].map(|k| (p.u[k] - q.u[k]) / length);
        let moment = p.a * q.a * (length / (p.a + q.a)).powi(2);
        let mut rest = merge_pairs(candidate, &[(i, j)]);
        let united = rest.sources.remove(j);
        let parts = (prior.multiple(&united).round() as usize).max(1);
        [moment, TYPICAL_MOMENT].into_iter().any(|moment| {
            let mut next = rest.clone();
            next.sources.extend(divide_source(united, parts, direction, moment));
            search.try_accept(candidate, next)
        })
    })
}

/// Divides a source into equal parts on a line with the second moment `moment`, σ², within the limits of the spacing.
fn divide_source(
    source: PointSource,
    parts: usize,
    direction: [f64; 2],
    moment: f64,
) -> impl Iterator<Item = PointSource> {
    let parts = parts.min(MAX_PARTS);
    let spacing = (12.0 * moment / (parts * parts - 1).max(1) as f64)
        .sqrt()
        .clamp(SPACING[0], SPACING[1]);
    (0..parts).map(move |k| {
        let shift = spacing * (k as f64 - 0.5 * (parts - 1) as f64);
        let u = [0, 1].map(|axis| source.u[axis] + shift * direction[axis]);
        PointSource::new(u, source.a / parts as f64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_divided_source_keeps_its_light_its_centre_and_its_second_moment() {
        let source = PointSource::new([3.0, -1.0], 90.0);
        let direction = [0.6, 0.8];
        // Three on a line, spaced by √(12 · 0.24/8) = 0.6: the moment is (0.36 + 0 + 0.36)/3.
        let parts: Vec<_> = divide_source(source, 3, direction, 0.24).collect();
        assert_eq!(parts.iter().map(|p| p.a).collect::<Vec<_>>(), [30.0; 3]);
        for (part, shift) in parts.iter().zip([-0.6, 0.0, 0.6]) {
            for k in 0..2 {
                assert!(
                    (part.u[k] - source.u[k] - shift * direction[k]).abs() < 1e-12,
                    "{part:?}"
                );
            }
        }
        assert_eq!(divide_source(source, 9, direction, 1.0).count(), MAX_PARTS);
    }
}
