//! Maximum a posteriori: number and positions of the emitters by the evidence of the frame and of known powers.

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::proposals::{close_pairs, merge_pairs};
use crate::estimate::model_order::search::{NUISANCE_PENALTY, Search, TRIAL_STEPS};

/// Rounds of proposals.
const ROUNDS: usize = 6;
/// A source is first assigned to a user unless −2 ln probability rises by more than this.
pub(crate) const ASSIGNMENT_SLACK: f64 = 60.0;
/// A source of this many times a known energy is proposed to be divided.
const MIN_MULTIPLE: f64 = 1.4;
/// Least and largest spacing of a divided source's parts, σ, and most parts.
const SPACING: [f64; 2] = [0.1, 0.8];
const MAX_PARTS: usize = 4;
/// The total light may differ from that of one user per source by this many users before divisions or unions are proposed.
const MAX_SURPLUS: f64 = 0.4;
/// Brightest sources divided in a round, pairs tried in a round, and the largest distance of a pair, σ.
const MAX_DIVISIONS: usize = 6;
const MAX_PAIRS: usize = 6;
const PAIR_DISTANCE: f64 = 4.0;

impl Search {
    /// Improves a hypothesis that explains the frame to the most probable one. Needs `self.prior`; does nothing without it.
    pub fn maximum_posterior(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        if self.prior.is_none() {
            return;
        }
        self.fit_with_prior(compressed, hypothesis, f64::INFINITY, 0.0);
        let known = hypothesis.clone();
        self.try_accept_map(compressed, hypothesis, known);
        let rules = self.rules();
        for _ in 0..ROUNDS {
            let before = self.score(hypothesis);
            if rules.explore_ill_determined {
                self.explore_ill_determined(compressed, hypothesis);
            }
            if rules.divide {
                self.propose_divisions(compressed, hypothesis);
            }
            if rules.balance_pairs {
                self.propose_balanced_pairs(compressed, hypothesis);
            }
            if rules.unite {
                self.propose_unions(compressed, hypothesis);
            }
            self.propose_shrinkage(compressed, hypothesis);
            self.propose_growth(compressed, hypothesis);
            if before - self.score(hypothesis) < 0.1 || self.is_exhausted() {
                break;
            }
        }
        self.converge(compressed, hypothesis);
    }

    /// Fits `hypothesis` under the prior: sources are assigned with `leniency` first and by their energy after the fit. Sets the log
    /// evidence term.
    pub(crate) fn fit_with_prior(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        acceptance_threshold: f64,
        leniency: f64,
    ) {
        let Some(prior) = self.prior.take() else { return };
        prior.assign_components(hypothesis, leniency);
        self.fitter
            .fit_below(compressed, hypothesis, TRIAL_STEPS, acceptance_threshold);
        if prior.assign_components(hypothesis, 0.0) {
            self.fitter.fit(compressed, hypothesis, TRIAL_STEPS);
        }
        hypothesis.log_evidence_term = self.log_evidence_term(compressed, hypothesis, &prior);
        self.prior = Some(prior);
    }

    /// −2 ln of the Occam factor (Laplace; MacKay, 2003, eq. 28.10) and of the prior, which is uniform over the sensor in position and
    /// symmetric in the emitters' order.
    fn log_evidence_term(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        prior: &PowerPrior,
    ) -> f64 {
        let n = hypothesis.sources.len();
        let (bx, by) = (&self.fitter.bx, &self.fitter.by);
        let side = |b: &crate::estimate::model::svd_basis::Basis| b.max_position() - b.min_position();
        let area = side(bx) * side(by);
        // The prior's precision of a position: never wider than the spot and a pixel.
        let least = |b: &crate::estimate::model::svd_basis::Basis| 1.0 / (0.25 + b.pitch() * b.pitch() / 12.0);
        let floors = |s: &PointSource| [least(bx), least(by), prior.least_precision(s)];
        let floor: Vec<_> = hypothesis.sources.iter().map(floors).collect();
        let p = hypothesis.parameters();
        self.fitter.compute_information(compressed, hypothesis);
        let log_det = self.fitter.log_det(p, &floor).unwrap_or(f64::INFINITY);
        let orders: f64 = (2..=n).map(|k| 2.0 * (k as f64).ln()).sum();
        let volume = n as f64 * (2.0 * area.ln() - 3.0 * std::f64::consts::TAU.ln());
        let nuisances = NUISANCE_PENALTY * hypothesis.nuisances.count() as f64;
        prior.tempering * (log_det + volume - orders + nuisances) + prior.total_cost(hypothesis)
    }

    /// Fits `next` with sources assigned to users in case of doubt and keeps it if it is more probable.
    pub(crate) fn try_accept_map(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        mut next: Hypothesis,
    ) -> bool {
        if self.is_exhausted() {
            return false;
        }
        let acceptance_threshold = self.acceptance_threshold(hypothesis, &next);
        self.fit_with_prior(compressed, &mut next, acceptance_threshold, ASSIGNMENT_SLACK);
        let is_better = self.score(&next) < self.score(hypothesis) - 1e-6;
        if is_better {
            *hypothesis = next;
        }
        is_better
    }

    /// Total light in excess of one user per source, in users.
    fn source_surplus(&self, hypothesis: &Hypothesis) -> f64 {
        let Some(prior) = &self.prior else { return 0.0 };
        hypothesis.sources.iter().map(|s| prior.multiple(s) - 1.0).sum()
    }

    /// Proposes several sources in the place of one that has the light of several users.
    fn propose_divisions(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let Some(prior) = &self.prior else { return };
        let mut multiples: Vec<(f64, usize)> = hypothesis.sources.iter().map(|s| prior.multiple(s)).zip(0..).collect();
        multiples.sort_by(|p, q| q.0.total_cmp(&p.0));
        let least = if self.source_surplus(hypothesis) > MAX_SURPLUS {
            0.0
        } else {
            MIN_MULTIPLE
        };
        multiples.retain(|b| b.0 > least);
        multiples.truncate(MAX_DIVISIONS);
        if multiples.is_empty() {
            return;
        }
        let directions = self.split_proposals(compressed, hypothesis);
        for (multiple, index) in multiples {
            let source = hypothesis.sources[index];
            let split = directions.iter().find(|d| d.index == index);
            let (along, spread) = split.map_or(([1.0, 0.0], 0.0), |d| (d.direction, d.distance * d.distance));
            let parts = (multiple.round() as usize).max(2);
            let across = [-along[1], along[0]];
            for (direction, spread) in [(along, spread), (along, 1.0), (across, 1.0)] {
                let mut next = hypothesis.clone();
                next.sources.remove(index);
                next.sources.extend(divide_source(source, parts, direction, spread));
                if self.try_accept_map(compressed, hypothesis, next) {
                    return;
                }
            }
        }
    }

    /// Proposes to divide the light of two sources evenly among as many users as it is of, where one of them matches no known power.
    fn propose_balanced_pairs(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let Some(prior) = &self.prior else { return };
        let is_unassigned = |p: &&(f64, usize, usize)| {
            hypothesis.sources[p.1].power.is_none() || hypothesis.sources[p.2].power.is_none()
        };
        let near = close_pairs(hypothesis, PAIR_DISTANCE);
        let unassigned: Vec<(usize, usize, f64)> = near
            .iter()
            .filter(is_unassigned)
            .take(MAX_PAIRS)
            .map(|&(_, i, j)| (i, j, prior.multiple(&merge_pairs(hypothesis, &[(i, j)]).sources[j])))
            .collect();
        for (i, j, multiple) in unassigned {
            let [p, q] = [i, j].map(|k| hypothesis.sources[k].u);
            let d = [0, 1].map(|k| p[k] - q[k]);
            let length = d[0].hypot(d[1]).max(1e-6);
            let [a, b] = [i, j].map(|k| hypothesis.sources[k].a);
            let spread = a * b * (length / (a + b)).powi(2);
            let mut united = merge_pairs(hypothesis, &[(i, j)]);
            let source = united.sources.remove(j);
            let parts = (multiple.round() as usize).max(1);
            for spread in [spread, 1.0] {
                let mut next = united.clone();
                next.sources
                    .extend(divide_source(source, parts, d.map(|v| v / length), spread));
                if self.try_accept_map(compressed, hypothesis, next) {
                    return;
                }
            }
        }
    }

    /// Proposes one source in the place of two where there are more sources than users' light.
    fn propose_unions(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        if self.source_surplus(hypothesis) > -MAX_SURPLUS {
            return;
        }
        for (_, i, j) in close_pairs(hypothesis, PAIR_DISTANCE).into_iter().take(MAX_PAIRS) {
            let next = merge_pairs(hypothesis, &[(i, j)]);
            if self.try_accept_map(compressed, hypothesis, next) {
                return;
            }
        }
    }
}

/// Divides a source into equal parts on a line with the second moment `spread`, σ², within the limits of the spacing.
fn divide_source(
    source: PointSource,
    parts: usize,
    direction: [f64; 2],
    spread: f64,
) -> impl Iterator<Item = PointSource> {
    let parts = parts.min(MAX_PARTS);
    let spacing = (12.0 * spread / (parts * parts - 1).max(1) as f64)
        .sqrt()
        .clamp(SPACING[0], SPACING[1]);
    (0..parts).map(move |k| {
        let shift = spacing * (k as f64 - 0.5 * (parts - 1) as f64);
        let u = [0, 1].map(|axis| source.u[axis] + shift * direction[axis]);
        PointSource::new(u, source.a / parts as f64)
    })
}
