//! Nuisance selection: a background, another width or a rotated ellipse may explain a frame better than more emitters.

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, Width};
use crate::estimate::model_order::proposals::{close_pairs, merge_pairs};
use crate::estimate::model_order::search::{EARLY_ROUNDS, ROUNDS, Search, TRIAL_STEPS};
use crate::estimate::preprocess::screening::PreprocessedFrame;

/// Ratio of energies from which overlapping sources may be an artefact of a wrong width or background.
const MAX_ENERGY_RATIO: f64 = 3.0;
/// Wald statistic, in source penalties, from which a source is never pruned.
const CERTAIN: f64 = 100.0;
/// Radius of the neighbourhood whose misfit a source must exceed, σ.
const NEIGHBOURHOOD: f64 = 2.0;
/// The nuisances tried in the place of more emitters.
pub(crate) const BACKGROUND_AND_WIDTH: Nuisances = Nuisances {
    background: true,
    width: Width::Common,
};
const ROTATED_ELLIPSE: Nuisances = Nuisances {
    background: true,
    width: Width::RotatedEllipse,
};
/// Rotated ellipses: shares of a frame's work before and after they have reduced the excess deviance to `ELLIPSE_GAIN` of it.
const ELLIPSE_TRIAL_WORK: f64 = 0.2;
const ELLIPSE_WORK: f64 = 0.7;
const ELLIPSE_GAIN: f64 = 0.02;
/// Sources within this distance, σ, may be one source with an elliptical PSF.
const CLOSE_PAIR_DISTANCE: f64 = 1.5;
/// Wald statistic, in source penalties, below which a source may be an artefact of a background or a width.
const DOUBTFUL: f64 = 4.0;
/// Steps of a fit from the pencil's positions with nuisances.
const NUISANCE_FIT_STEPS: usize = 150;

impl Search {
    /// Tries a background, another width, or both instead of more emitters and keeps what scores better than `hypothesis`.
    pub(crate) fn select_nuisances(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        hypothesis: &mut Hypothesis,
    ) {
        if hypothesis.nuisances == BACKGROUND_AND_WIDTH
            && compressed.is_explained_by(hypothesis)
            && !self.has_unequal_energies(hypothesis)
        {
            return;
        }
        let lit = Nuisances {
            background: true,
            width: Width::Known,
        };
        // A background has singular values of its own, which the pencil would count as emitters.
        let grown = if self.pencil.is_some() {
            let mut grown = Hypothesis::empty(lit);
            self.fitter.fit(compressed, &mut grown, TRIAL_STEPS);
            self.refine(compressed, &mut grown, ROUNDS);
            grown
        } else {
            self.initialise(compressed, frame, lit, NUISANCE_FIT_STEPS)
        };
        self.keep_better(hypothesis, grown);
        if compressed.is_explained_by(hypothesis) && !self.has_unequal_energies(hypothesis) {
            let mut next = hypothesis.clone();
            next.nuisances = BACKGROUND_AND_WIDTH;
            self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
            self.refine(compressed, &mut next, EARLY_ROUNDS);
            self.keep_better(hypothesis, next);
        }
        if !compressed.is_explained_by(hypothesis) || self.has_unequal_energies(hypothesis) {
            let next = self.initialise(compressed, frame, BACKGROUND_AND_WIDTH, NUISANCE_FIT_STEPS);
            self.keep_better(hypothesis, next);
        }
        if !compressed.is_explained_by(hypothesis)
            && let Some(wider) = self.with_more_nuisances(compressed, hypothesis, hypothesis)
        {
            *hypothesis = wider;
        }
    }

    /// Whether a background and another width can replace sources of a hypothesis that explains the frame.
    pub(crate) fn nuisances_can_replace_sources(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &Hypothesis,
    ) -> bool {
        let mut next = hypothesis.clone();
        next.nuisances = BACKGROUND_AND_WIDTH;
        self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
        let significance = self.wald_statistics(compressed, &mut next);
        if significance
            .iter()
            .filter(|s| **s < DOUBTFUL * self.source_penalty)
            .count()
            < 2
        {
            return false;
        }
        self.propose_shrinkage(compressed, &mut next);
        self.score(&next) < self.score(hypothesis)
    }

    fn keep_better(&self, hypothesis: &mut Hypothesis, next: Hypothesis) {
        if self.score(&next) < self.score(hypothesis) {
            *hypothesis = next;
        }
    }

    /// `hypothesis` with the further nuisances that score best, if any score better; fits that cannot beat `rival` are aborted.
    pub(crate) fn with_more_nuisances(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &Hypothesis,
        rival: &Hypothesis,
    ) -> Option<Hypothesis> {
        if hypothesis.sources.is_empty() {
            return None;
        }
        let mut best: Option<Hypothesis> = None;
        for width in [Width::Known, Width::Common, Width::PerAxis] {
            let nuisances = Nuisances {
                background: true,
                width,
            };
            if nuisances.count() <= hypothesis.nuisances.count() {
                continue;
            }
            let mut next = best.clone().unwrap_or_else(|| hypothesis.clone());
            next.nuisances = nuisances;
            let acceptance_threshold = self.acceptance_threshold(rival, &next);
            self.fitter
                .fit_below(compressed, &mut next, TRIAL_STEPS, acceptance_threshold);
            if self.score(&next) < best.as_ref().map_or(self.score(hypothesis), |b| self.score(b)) {
                let is_explained = compressed.is_explained_by(&next);
                best = Some(next);
                if is_explained {
                    break;
                }
            }
        }
        best
    }

    /// Tries a rotated elliptical PSF: from `hypothesis` with close pairs merged, or where spots overlap from the `first` hypothesis and
    /// from the pencil's positions.
    pub(crate) fn try_rotated_ellipse(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        first: Hypothesis,
        hypothesis: &mut Hypothesis,
    ) {
        if hypothesis.sources.is_empty() || self.is_heavily_masked(compressed) {
            return;
        }
        let is_overlapping = self.pencil.is_some();
        let mut next = if is_overlapping {
            first
        } else {
            merge_pairs(hypothesis, &disjoint_close_pairs(hypothesis))
        };
        next.nuisances = BACKGROUND_AND_WIDTH;
        self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
        if compressed.is_explained_by(&next) {
            return self.keep_better(hypothesis, next);
        }
        let left = next.deviance - compressed.data_count;
        next.nuisances = ROTATED_ELLIPSE;
        let limit = self.fitter.limit_work(ELLIPSE_TRIAL_WORK);
        self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
        self.fitter.restore_work_limit(limit);
        if !compressed.is_explained_by(&next) && next.deviance - compressed.data_count > ELLIPSE_GAIN * left {
            return;
        }
        self.fitter.limit_work(ELLIPSE_WORK);
        self.fitter.fit(compressed, &mut next, NUISANCE_FIT_STEPS);
        if compressed.is_explained_by(&next) {
            self.refine(compressed, &mut next, EARLY_ROUNDS);
        }
        self.keep_better(hypothesis, next);
        if is_overlapping && (!compressed.is_explained_by(hypothesis) || self.has_unequal_energies(hypothesis)) {
            let next = self.initialise(compressed, frame, ROTATED_ELLIPSE, NUISANCE_FIT_STEPS);
            self.keep_better(hypothesis, next);
        }
        self.fitter.restore_work_limit(limit);
    }

    /// Removes nuisances where the score improves without them.
    pub(crate) fn drop_nuisances(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let simpler = [
            Nuisances {
                background: hypothesis.nuisances.background,
                width: Width::Known,
            },
            Nuisances {
                background: false,
                width: hypothesis.nuisances.width,
            },
            Nuisances::default(),
        ];
        for nuisances in simpler {
            if nuisances.count() < hypothesis.nuisances.count() {
                let mut next = hypothesis.clone();
                next.restrict_nuisances(nuisances);
                self.try_accept(compressed, hypothesis, next);
            }
        }
    }

    /// Whether overlapping sources differ so much in energy that some may be an artefact of a background or another width.
    pub(crate) fn has_unequal_energies(&self, hypothesis: &Hypothesis) -> bool {
        let energies = hypothesis.sources.iter().map(|s| s.a);
        let [least, most] = [
            energies.clone().fold(f64::INFINITY, f64::min),
            energies.fold(0.0, f64::max),
        ];
        self.pencil.is_some() && most > MAX_ENERGY_RATIO * least
    }

    /// Whether the dark parts of the frame are brighter or darker than the noise. Only where spots leave parts dark; a fainter
    /// background shows in the residual.
    pub(crate) fn has_visible_background(&self, frame: &PreprocessedFrame) -> bool {
        if self.pencil.is_some() {
            return false;
        }
        let (mut usable, mut low) = (0.0, 0.0);
        for (p, _) in frame.pixels.iter().zip(&frame.is_masked).filter(|(_, bad)| !**bad) {
            usable += 1.0;
            low += f64::from(u8::from(*p < -1.0));
        }
        // The share of standard normal noise below −1.
        let expected: f64 = 0.1587 * usable;
        low < 0.25 * expected - 5.0 || low > expected + 5.0 * expected.sqrt()
    }

    /// Removes sources that do not exceed the misfit around them: where gain scatter or a wrong PSF leaves a residual that grows with
    /// the light, a source must be significant against that residual and not only against the noise.
    pub(crate) fn prune_spurious(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        hypothesis: &mut Hypothesis,
    ) {
        let mut image = Vec::new();
        loop {
            let significance = self.wald_statistics(compressed, hypothesis);
            let mut order: Vec<usize> = (0..hypothesis.sources.len()).collect();
            order.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
            let mut has_dropped = false;
            for index in order
                .into_iter()
                .take_while(|&i| significance[i] < CERTAIN * self.source_penalty)
            {
                let source = hypothesis.sources[index];
                let mut next = hypothesis.clone();
                next.sources.remove(index);
                self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
                let residual = self.fitter.weighted_residual(compressed, &mut next).to_vec();
                let (bx, by) = (&self.fitter.bx, &self.fitter.by);
                compressed.expand_matrix(&residual, bx, by, &mut image);
                let (mut sum, mut count) = (0.0, 0.0);
                for (k, r) in image.iter().enumerate().filter(|(k, _)| !frame.is_masked[*k]) {
                    let x = bx.edges[k % bx.n] + 0.5 * bx.pitch() - source.u[0];
                    let y = by.edges[k / bx.n] + 0.5 * by.pitch() - source.u[1];
                    if x * x + y * y < NEIGHBOURHOOD * NEIGHBOURHOOD {
                        sum += r * r;
                        count += 1.0;
                    }
                }
                let share = compressed.data_count / image.len() as f64;
                let around = if count > 0.0 {
                    (sum / count / share).max(1.0)
                } else {
                    1.0
                };
                if next.deviance - hypothesis.deviance < self.source_penalty * around {
                    *hypothesis = next;
                    has_dropped = true;
                    break;
                }
            }
            if !has_dropped {
                return;
            }
        }
    }
}

/// Pairs of close sources, each source in at most one.
fn disjoint_close_pairs(hypothesis: &Hypothesis) -> Vec<(usize, usize)> {
    let mut chosen: Vec<(usize, usize)> = Vec::new();
    for (_, i, j) in close_pairs(hypothesis, CLOSE_PAIR_DISTANCE) {
        if chosen
            .iter()
            .all(|&(a, b)| ![a, b].contains(&i) && ![a, b].contains(&j))
        {
            chosen.push((i, j));
        }
    }
    chosen
}

/// Whether so many sources come in close pairs that an elliptical PSF may be the cause.
pub(crate) fn has_paired_sources(hypothesis: &Hypothesis) -> bool {
    let disjoint_close_pairs = disjoint_close_pairs(hypothesis).len();
    disjoint_close_pairs > 1 && 4 * disjoint_close_pairs >= hypothesis.sources.len()
}
