//! Proposals that change the number of sources: birth, split, relocation, merge, death.

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model_order::search::{Search, TRIAL_STEPS};
use crate::estimate::uncertainty::pixel_posterior::WIDE_PIXEL;
use crate::estimate::uncertainty::split_score_test::SplitProposal;

/// Steps of the last fit before a hypothesis is reported.
const CONVERGE_STEPS: usize = 200;
/// Least distance of two residual peaks of one round, σ.
const PEAK_DISTANCE: f64 = 2.5;
/// Sources within this distance, σ, are proposed to be merged.
const MERGE_DISTANCE: f64 = 2.5;
/// The same in pixels, where pixels are wide; the quadratic prediction of the merge is then ignored.
const MERGE_PIXELS: f64 = 1.6;
/// Merges proposed in a round: with narrow pixels, with wide ones.
const MAX_MERGES: [usize; 2] = [3, 8];
/// Within this distance, σ, the quadratic prediction of a merge is unreliable and ignored.
const UNRELIABLE_DISTANCE: f64 = 0.15;
/// Distance from the edge, σ, of a source that is relocated inside.
const INSET: f64 = 1.0;
/// Removal candidates, the faintest first, when an off-sensor source moves inside.
const REMOVAL_CANDIDATES: usize = 3;
/// Deaths proposed in a round.
const MAX_DEATHS: usize = 6;
/// Predicted gain, in source penalties, from which a split is proposed though the frame is explained.
const LIKELY_SPLIT: f64 = 0.6;
/// Least and largest distance of a split's halves from the source, σ.
const SPLIT_DISTANCE: [f64; 2] = [0.4, 1.0];

impl Search {
    /// Applies proposals to `hypothesis` until none improves the score, then fits to convergence.
    pub fn refine(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis, rounds: usize) {
        for _ in 0..rounds {
            let before = self.score(hypothesis);
            if !compressed.is_explained_by(hypothesis) {
                self.converge(compressed, hypothesis);
            }
            self.propose_growth(compressed, hypothesis);
            self.propose_shrinkage(compressed, hypothesis);
            if before - self.score(hypothesis) < 0.1 || self.is_exhausted() {
                break;
            }
        }
        self.converge(compressed, hypothesis);
    }

    pub(crate) fn converge(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        if !hypothesis.converged {
            self.fitter.fit(compressed, hypothesis, CONVERGE_STEPS);
        }
    }

    /// Fits `next` and keeps it if it scores better.
    pub(crate) fn try_accept(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        mut next: Hypothesis,
    ) -> bool {
        if next.sources.len() > compressed.max_sources() || self.is_exhausted() {
            return false;
        }
        if self.prior.is_some() {
            return self.try_accept_map(compressed, hypothesis, next);
        }
        let acceptance_threshold = self.acceptance_threshold(hypothesis, &next);
        self.fitter
            .fit_below(compressed, &mut next, TRIAL_STEPS, acceptance_threshold);
        let is_better = self.score(&next) < self.score(hypothesis) - 1e-6;
        if is_better {
            *hypothesis = next;
        }
        is_better
    }

    pub(crate) fn residual_peaks(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
    ) -> &[crate::estimate::detect::matched_filter::Peak] {
        self.residual.clear();
        self.residual
            .extend_from_slice(self.fitter.weighted_residual(compressed, hypothesis));
        let (mx, my) = (compressed.mx, compressed.my);
        // The part of a peak that other sources have absorbed comes back in the joint fit: use a lower threshold.
        let threshold = 0.7 * (self.noise_inflation * self.source_penalty).sqrt();
        self.matched_filter
            .peaks(&self.residual, mx, my, threshold, PEAK_DISTANCE)
    }

    /// Proposes births, splits and relocations.
    pub(crate) fn propose_growth(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let rules = self.rules();
        let peaks: Vec<_> = self
            .residual_peaks(compressed, hypothesis)
            .iter()
            .take(2)
            .copied()
            .collect();
        for peak in peaks.iter().filter(|_| rules.birth) {
            let mut next = hypothesis.clone();
            next.sources.push(PointSource::new(peak.u, peak.a));
            if self.try_accept(compressed, hypothesis, next) {
                break;
            }
        }
        let splits = if rules.split {
            self.split_proposals(compressed, hypothesis)
        } else {
            Vec::new()
        };
        for split in splits.into_iter().take(3) {
            let is_likely = split.gain > LIKELY_SPLIT * self.noise_inflation * self.source_penalty;
            if compressed.is_explained_by(hypothesis) && !is_likely {
                break;
            }
            if self.try_accept(compressed, hypothesis, split_source(hypothesis, &split)) {
                return;
            }
        }
        if !rules.relocate || compressed.is_explained_by(hypothesis) {
            return;
        }
        let Some(peak) = peaks.first() else { return };
        let mut weakest: Vec<usize> = (0..hypothesis.sources.len()).collect();
        weakest.sort_by(|&i, &j| hypothesis.sources[i].a.total_cmp(&hypothesis.sources[j].a));
        for index in weakest.into_iter().take(3) {
            let mut next = hypothesis.clone();
            next.sources[index] = PointSource::new(peak.u, peak.a);
            if self.try_accept(compressed, hypothesis, next) {
                return;
            }
        }
    }

    /// Proposes merges, deaths and relocations inside.
    pub fn propose_shrinkage(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let rules = self.rules();
        while rules.merge_all && self.merge_all_unresolved(compressed, hypothesis) {}
        let pitch = self.fitter.bx.pitch().max(self.fitter.by.pitch());
        let is_wide = rules.merge_wide_pixels && pitch > WIDE_PIXEL;
        let limit = if is_wide {
            MERGE_DISTANCE.max(MERGE_PIXELS * pitch)
        } else {
            MERGE_DISTANCE
        };
        loop {
            let n = hypothesis.sources.len();
            let mut has_shrunk = false;
            for (d, i, j) in close_pairs(hypothesis, limit)
                .into_iter()
                .filter(|_| rules.merge)
                .take(MAX_MERGES[usize::from(is_wide)])
            {
                if !is_wide
                    && d > UNRELIABLE_DISTANCE
                    && self.merge_deviance_rise(compressed, hypothesis, i, j)
                        > 8.0 * self.noise_inflation * self.source_penalty
                {
                    continue;
                }
                let next = merge_pairs(hypothesis, &[(i, j)]);
                if self.try_accept(compressed, hypothesis, next) {
                    has_shrunk = true;
                    break;
                }
            }
            if rules.death && !has_shrunk {
                // The least significant source may be one of an unresolved pair, and needed.
                let significance = self.wald_statistics(compressed, hypothesis);
                let mut faint: Vec<usize> = (0..n).collect();
                faint.retain(|&i| significance[i] < 4.0 * self.noise_inflation * self.source_penalty);
                faint.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
                for index in faint.into_iter().take(MAX_DEATHS) {
                    let mut next = hypothesis.clone();
                    next.sources.remove(index);
                    if self.try_accept(compressed, hypothesis, next) {
                        has_shrunk = true;
                        break;
                    }
                }
            }
            if !has_shrunk && !self.relocate_inside(compressed, hypothesis) {
                break;
            }
        }
    }

    /// Proposes to remove a source and relocate one from beyond the sensor's edge to the inside: two sources at the edge may fit the tail
    /// of one that the edge cuts.
    fn relocate_inside(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> bool {
        if !self.rules().relocate_inside || !compressed.is_explained_by(hypothesis) {
            return false;
        }
        let axes = [&self.fitter.bx, &self.fitter.by];
        let ends = axes.map(|b| [b.edges[0], b.edges[b.n]]);
        let is_outside = |i: usize| (0..2).any(|k| !(ends[k][0]..=ends[k][1]).contains(&hypothesis.sources[i].u[k]));
        let outside: Vec<usize> = (0..hypothesis.sources.len()).filter(|&i| is_outside(i)).collect();
        let mut spare: Vec<usize> = (0..hypothesis.sources.len()).collect();
        spare.sort_by(|&i, &j| hypothesis.sources[i].a.total_cmp(&hypothesis.sources[j].a));
        spare.truncate(REMOVAL_CANDIDATES);
        spare.extend(&outside);
        for &k in &outside {
            for &i in spare.iter().filter(|&&i| i != k) {
                let mut next = hypothesis.clone();
                for (u, [low, high]) in next.sources[k].u.iter_mut().zip(ends) {
                    let inside = INSET.min(0.5 * (high - low));
                    *u = u.max(low + inside).min(high - inside);
                }
                next.sources.remove(i);
                if self.try_accept(compressed, hypothesis, next) {
                    return true;
                }
            }
        }
        false
    }

    /// Proposes to merge all unresolved pairs at once, where there are several.
    fn merge_all_unresolved(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> bool {
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        for (_, i, j) in close_pairs(hypothesis, MERGE_DISTANCE) {
            let is_free = chosen
                .iter()
                .all(|&(a, b)| ![a, b].contains(&i) && ![a, b].contains(&j));
            if is_free
                && self.merge_deviance_rise(compressed, hypothesis, i, j) < self.noise_inflation * self.source_penalty
            {
                chosen.push((i, j));
            }
        }
        chosen.len() > 1 && self.try_accept(compressed, hypothesis, merge_pairs(hypothesis, &chosen))
    }

    /// Squared amplitude over its variance, for each source (Wald's test).
    pub(crate) fn wald_statistics(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> Vec<f64> {
        let (p, n) = (hypothesis.parameters(), hypothesis.sources.len());
        if !self.update_covariance(compressed, hypothesis) {
            return vec![0.0; n];
        }
        let cov = &self.covariance_cache.covariance;
        (0..n)
            .map(|i| hypothesis.sources[i].a.powi(2) / cov[(3 * i + 2) * p + 3 * i + 2].max(1e-300))
            .collect()
    }

    /// Predicted rise of the deviance, to second order, when sources i and j are merged.
    fn merge_deviance_rise(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        i: usize,
        j: usize,
    ) -> f64 {
        let p = hypothesis.parameters();
        if !self.update_covariance(compressed, hypothesis) {
            return 0.0;
        }
        let cov = &self.covariance_cache.covariance;
        let at = |a: usize, r: usize, b: usize, c: usize| cov[(3 * a + r) * p + 3 * b + c];
        let d = [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k]);
        let s = [0, 1].map(|r| [0, 1].map(|c| at(i, r, i, c) + at(j, r, j, c) - at(i, r, j, c) - at(j, r, i, c)));
        let det = s[0][0] * s[1][1] - s[0][1] * s[1][0];
        (d[0] * d[0] * s[1][1] - 2.0 * d[0] * d[1] * s[0][1] + d[1] * d[1] * s[0][0]) / det.max(1e-300)
    }

    /// Splits suggested by the score test, the largest predicted gain first.
    pub(crate) fn split_proposals(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
    ) -> Vec<SplitProposal> {
        let is_known = self.covariance_cache.is_of(hypothesis);
        if self.is_exhausted() || !self.update_covariance(compressed, hypothesis) {
            return Vec::new();
        }
        if let Some(known) = &self.covariance_cache.splits {
            return known.clone();
        }
        if is_known {
            self.fitter.compute_information(compressed, hypothesis);
        }
        let scores = self
            .fitter
            .second_moment_scores(compressed, hypothesis, &self.covariance_cache.covariance);
        let mut splits: Vec<_> = scores.iter().enumerate().filter_map(|(i, b)| b.split(i)).collect();
        splits.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        self.covariance_cache.splits = Some(splits.clone());
        splits
    }

    /// Updates the cached covariance to `hypothesis`; `false` where its information is singular.
    fn update_covariance(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> bool {
        if !self.covariance_cache.is_of(hypothesis) {
            self.fitter.compute_information(compressed, hypothesis);
            let known = &mut self.covariance_cache;
            let (p, n) = (hypothesis.parameters(), hypothesis.sources.len());
            known.is_regular = self.fitter.covariance(p, n, 1e-9, &mut known.covariance);
            known.splits = None;
            known.deviance = hypothesis.deviance;
            known.nuisances = hypothesis.nuisances;
            known.sources.clone_from(&hypothesis.sources);
        }
        self.covariance_cache.is_regular
    }
}

/// Covariance and splits of one hypothesis, which several proposals use.
#[derive(Default)]
pub(crate) struct CovarianceCache {
    sources: Vec<PointSource>,
    nuisances: Nuisances,
    deviance: f64,
    is_regular: bool,
    covariance: Vec<f64>,
    splits: Option<Vec<SplitProposal>>,
}

impl CovarianceCache {
    /// Compares the deviance too, because frames and weights differ in it.
    fn is_of(&self, hypothesis: &Hypothesis) -> bool {
        self.deviance == hypothesis.deviance
            && self.nuisances == hypothesis.nuisances
            && self.sources == hypothesis.sources
    }
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
