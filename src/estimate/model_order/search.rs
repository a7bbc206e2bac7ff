//! The search for the number of emitters: hypotheses are fitted jointly and compared by a penalised likelihood.

use std::time::Instant;

use crate::estimate::detect::matched_filter::MatchedFilter;
use crate::estimate::detect::matrix_pencil::{MatrixPencil, PencilSampler};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::nuisance_selection::{BACKGROUND_AND_WIDTH, has_paired_sources};
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::proposals::CovarianceCache;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;

/// Steps of a candidate's fit before it is compared.
pub(crate) const TRIAL_STEPS: usize = 30;
/// Extra emitters accepted before testing a background or width.
const ACCEPTED_EXTRA: usize = 2;
/// Steps of a fit from the pencil's positions.
const PENCIL_FIT_STEPS: usize = 100;
/// Rounds of proposals, and rounds before nuisances are tried.
pub(crate) const ROUNDS: usize = 8;
pub(crate) const EARLY_ROUNDS: usize = 3;
/// Misfit in standard deviations from which nuisances are tried.
const MISFIT_DEVIATIONS: f64 = 5.0;
/// Slack on the acceptance bound for the unknown evidence term.
const ACCEPTANCE_SLACK: f64 = 30.0;
/// Overlapping sources above this number are first tested for nuisances.
const MAX_CLUSTER: usize = 10;
/// Largest masked fraction for which the matrix pencil and rotated ellipses are used: the pencil sees the fill values.
const MAX_MASKED_SHARE: f64 = 0.03;
/// Least decrease of the deviance for a nuisance parameter.
pub(crate) const NUISANCE_PENALTY: f64 = 5.0;

/// The search for the number of sources in one pair of bases.
pub(crate) struct Search {
    pub fitter: Fitter,
    pub matched_filter: MatchedFilter,
    /// The matrix pencil, where spots are wide enough against the sensor.
    pub(crate) pencil: Option<PencilSampler>,
    /// Least decrease of the deviance for a source.
    pub source_penalty: f64,
    /// Noise variance weighted by the frame's light: multiplies all penalties.
    pub noise_inflation: f64,
    /// The variance function, where noise that grows with the light explains a frame better than more sources.
    pub suspected_variance: Option<VarianceFunction>,
    /// The prior of energies, for the maximum a posteriori.
    pub prior: Option<PowerPrior>,
    pub(crate) residual: Vec<f64>,
    pub(crate) covariance_cache: CovarianceCache,
}

impl Search {
    pub fn new([bx, by]: [Basis; 2], rules: Rules) -> Self {
        let pencil = PencilSampler::new(&bx, &by);
        Self::with(pencil, bx, by, rules)
    }

    /// For a first try by the pencil where [`Search::new`] begins with residual peaks.
    pub fn for_pencil_start([bx, by]: [Basis; 2], rules: Rules) -> Option<Self> {
        let pencil = PencilSampler::for_pencil_start(&bx, &by)?;
        Some(Self::with(Some(pencil), bx, by, rules))
    }

    fn with(pencil: Option<PencilSampler>, bx: Basis, by: Basis, rules: Rules) -> Self {
        let fitter = Fitter::new(bx, by, rules);
        let matched_filter = MatchedFilter::new(&fitter.bx, &fitter.by);
        let area = |b: &Basis| b.edges[b.n] - b.edges[0];
        // The matched filter has about area/σ² independent positions; the penalty keeps the probability that any of
        // them exceeds it in an empty frame below 1e-3.
        let source_penalty = (10.0 + 2.0 * (area(&fitter.bx) * area(&fitter.by)).ln()).max(14.0);
        Self {
            fitter,
            matched_filter,
            pencil,
            source_penalty,
            noise_inflation: 1.0,
            suspected_variance: None,
            prior: None,
            residual: Vec::new(),
            covariance_cache: CovarianceCache::default(),
        }
    }

    /// Starts a new frame.
    pub fn reset(&mut self, deadline: Option<Instant>) {
        self.fitter.reset(deadline);
        self.noise_inflation = 1.0;
        self.suspected_variance = None;
        self.covariance_cache = CovarianceCache::default();
    }

    pub(crate) fn rules(&self) -> Rules {
        self.fitter.rules
    }

    /// Whether the frame's budget of work or time is spent.
    pub fn is_exhausted(&self) -> bool {
        self.fitter.is_exhausted()
    }

    /// Deviance below which `next` scores better than `best`.
    pub(crate) fn acceptance_threshold(&self, best: &Hypothesis, next: &Hypothesis) -> f64 {
        let penalty = match &self.prior {
            None => self.penalty(next),
            // The evidence term is known only after the fit: one more source of a known power may even lower it.
            Some(_) if best.sources.is_empty() => return f64::INFINITY,
            Some(_) => {
                best.log_evidence_term * (next.sources.len() as f64 / best.sources.len() as f64).min(1.0)
                    - ACCEPTANCE_SLACK
            }
        };
        self.score(best) - penalty
    }

    /// The criterion: −2 ln likelihood plus the penalties of sources and nuisances; with a power prior, −2 ln of the posterior
    /// probability.
    pub fn score(&self, hypothesis: &Hypothesis) -> f64 {
        hypothesis.deviance + hypothesis.prior_penalty() + self.penalty(hypothesis)
    }

    fn penalty(&self, hypothesis: &Hypothesis) -> f64 {
        if self.prior.is_some() {
            return self.noise_inflation * hypothesis.log_evidence_term;
        }
        let nuisances = NUISANCE_PENALTY * hypothesis.nuisances.count() as f64;
        // A pair explains one elliptical spot too, and is likelier than an elliptical PSF: an ellipse costs a source more.
        let penalised = hypothesis.sources.len() + usize::from(hypothesis.nuisances.width == Width::RotatedEllipse);
        self.noise_inflation * (self.source_penalty * penalised as f64 + nuisances)
    }

    /// Maximum likelihood with the number of emitters unknown. Nuisances are fitted only where the frame cannot be
    /// explained without, and then within every hypothesis.
    pub fn maximum_likelihood(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        initial: Hypothesis,
    ) -> Hypothesis {
        self.noise_inflation = compressed.light_weighted_variance;
        let plain = initial.nuisances;
        let first = initial.clone();
        let mut hypothesis = if self.pencil.is_some() {
            initial
        } else {
            self.add_residual_peaks(compressed, frame, initial)
        };
        if self.suspected_variance.is_some() {
            return hypothesis;
        }
        let mut is_settled = compressed.is_explained_by(&hypothesis);
        if is_settled {
            self.refine(compressed, &mut hypothesis, ROUNDS);
        } else {
            self.reinitialise(compressed, &mut hypothesis);
        }
        let is_far = compressed.misfit(&hypothesis) > 1.0 + MISFIT_DEVIATIONS * (2.0 / compressed.data_count).sqrt();
        if is_far
            || hypothesis.nuisances != plain
            || self.has_unequal_energies(&hypothesis) && self.nuisances_can_replace_sources(compressed, &hypothesis)
        {
            if self.rules().select_nuisances {
                self.select_nuisances(compressed, frame, &mut hypothesis);
            }
            is_settled = false;
        }
        // An elliptical PSF takes several sources for one emitter.
        let may_be_turned = match self.pencil {
            None => has_paired_sources(&hypothesis),
            Some(_) => {
                !is_settled
                    && self.has_unequal_energies(&hypothesis)
                    && 3 * hypothesis.sources.len() > 4 * first.sources.len()
            }
        };
        let is_unexplained = !is_settled && !compressed.is_explained_by(&hypothesis);
        if self.rules().rotated_ellipse && (may_be_turned || is_unexplained) {
            self.try_rotated_ellipse(compressed, frame, first, &mut hypothesis);
            is_settled = false;
        }
        if !is_settled {
            self.fitter.reserve_work(0.3);
            self.refine(compressed, &mut hypothesis, ROUNDS);
        }
        self.drop_nuisances(compressed, &mut hypothesis);
        if self.rules().prune_spurious && !compressed.is_explained_by(&hypothesis) {
            self.prune_spurious(compressed, frame, &mut hypothesis);
        }
        self.converge(compressed, &mut hypothesis);
        hypothesis
    }

    /// Escapes a local minimum: frees nuisances, refits, removes them, then applies proposals. A result with more than one further source
    /// is discarded. Where only the fit with nuisances explains the frame, they stay.
    fn reinitialise(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let first = hypothesis.clone();
        let mut wide = None;
        if self.rules().free_nuisances && self.pencil.is_some() {
            let mut free = first.clone();
            free.nuisances = BACKGROUND_AND_WIDTH;
            self.fitter.fit(compressed, &mut free, TRIAL_STEPS);
            wide = Some(free.clone()).filter(|w| compressed.is_explained_by(w));
            free.restrict_nuisances(first.nuisances);
            self.fitter.fit(compressed, &mut free, TRIAL_STEPS);
            if self.score(&free) < self.score(hypothesis) {
                *hypothesis = free;
            }
        }
        if !compressed.is_explained_by(hypothesis) && first.sources.len() <= MAX_CLUSTER {
            self.refine(compressed, hypothesis, EARLY_ROUNDS);
        }
        if hypothesis.sources.len() > first.sources.len() + 1 {
            *hypothesis = first;
        }
        if let Some(mut wide) = wide.filter(|_| !compressed.is_explained_by(hypothesis)) {
            self.refine(compressed, &mut wide, EARLY_ROUNDS);
            if !self.has_unequal_energies(&wide) && self.score(&wide) < self.score(hypothesis) {
                *hypothesis = wide;
            }
        }
    }

    /// The initial hypothesis: the pencil's sources, or the residual peaks of one round, with a background where one is visible. Good
    /// enough to find isolated outliers in the residual.
    pub fn initial_hypothesis(&mut self, compressed: &CompressedFrame, frame: &PreprocessedFrame) -> Hypothesis {
        self.noise_inflation = compressed.light_weighted_variance;
        if self.pencil.is_some() {
            return self.initialise(compressed, frame, Nuisances::default(), PENCIL_FIT_STEPS);
        }
        let mut hypothesis = Hypothesis::empty(Nuisances {
            background: self.has_visible_background(frame),
            width: Width::Known,
        });
        let peaks = self.residual_peaks(compressed, &mut hypothesis);
        let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
        let sources = peaks
            .iter()
            .take_while(|p| p.significance >= least)
            .take(compressed.max_sources());
        hypothesis.sources = sources.map(|p| PointSource::new(p.u, p.a)).collect();
        self.fitter.fit(compressed, &mut hypothesis, TRIAL_STEPS);
        hypothesis
    }

    /// Adds peaks of the residual to `hypothesis` until none is significant, refitting all emitters each time.
    pub fn add_residual_peaks(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        mut hypothesis: Hypothesis,
    ) -> Hypothesis {
        while hypothesis.sources.len() < compressed.max_sources()
            && (hypothesis.sources.is_empty() || !compressed.is_explained_by(&hypothesis))
        {
            let room = compressed.max_sources() - hypothesis.sources.len();
            let mut next = hypothesis.clone();
            let peaks = self.residual_peaks(compressed, &mut hypothesis);
            let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
            let strong = peaks.iter().take_while(|p| p.significance >= least).take(room);
            next.sources.extend(strong.map(|p| PointSource::new(p.u, p.a)));
            if next.sources.len() == hypothesis.sources.len() {
                break;
            }
            self.fitter.fit(compressed, &mut next, TRIAL_STEPS);
            // Apparent sources may be a background or another width: the better score decides.
            if !compressed.is_explained_by(&next) || next.sources.len() > hypothesis.sources.len() + ACCEPTED_EXTRA {
                let wider = self.with_more_nuisances(compressed, &hypothesis, &next);
                if let Some(wider) = wider.filter(|w| self.score(w) < self.score(&next)) {
                    next = wider;
                }
            }
            if !compressed.is_explained_by(&next) {
                self.suspected_variance = self.test_variance_growth(compressed, frame, &mut hypothesis, &next);
            }
            if self.suspected_variance.is_some() || self.score(&next) > self.score(&hypothesis) {
                break;
            }
            hypothesis = next;
            if self.is_exhausted() {
                break;
            }
        }
        hypothesis
    }

    pub(crate) fn is_heavily_masked(&self, compressed: &CompressedFrame) -> bool {
        compressed.masked.len() as f64 > MAX_MASKED_SHARE * (self.fitter.bx.n * self.fitter.by.n) as f64
    }

    /// Fits the pencil's positions for rising numbers of sources until the frame is explained.
    fn initialise_by_pencil(
        &mut self,
        compressed: &CompressedFrame,
        nuisances: Nuisances,
        polish: usize,
    ) -> Option<Hypothesis> {
        if self.is_heavily_masked(compressed) {
            return None;
        }
        let pencil = self
            .pencil
            .as_mut()?
            .analyse(compressed, &self.fitter.bx, &self.fitter.by)?;
        let sure = pencil.singular_value_ratio.iter().take_while(|&&s| s > 4.0).count();
        let likely = pencil.singular_value_ratio.iter().take_while(|&&s| s > 0.5).count();
        let last = (likely + 2).min(pencil.most()).min(compressed.max_sources());
        let mut best = Hypothesis::empty(nuisances);
        self.fitter.fit(compressed, &mut best, TRIAL_STEPS);
        // A background and another width have singular values of their own.
        let is_plain = nuisances == Nuisances::default();
        let (first, beyond) = if is_plain { (sure, 2) } else { (sure / 3, 3) };
        self.fit_pencil_orders(
            compressed,
            &pencil,
            &mut best,
            nuisances,
            first.max(1)..=last.min(sure.max(3) + beyond),
            polish,
        );
        Some(best)
    }

    /// Fits the pencil's positions for each count until `best`, which keeps the better score, explains the frame.
    fn fit_pencil_orders(
        &mut self,
        compressed: &CompressedFrame,
        pencil: &MatrixPencil,
        best: &mut Hypothesis,
        nuisances: Nuisances,
        counts: std::ops::RangeInclusive<usize>,
        polish: usize,
    ) {
        let patience = if nuisances == Nuisances::default() { 1 } else { 3 };
        let mut worse = 0;
        for count in counts {
            if compressed.is_explained_by(best) || worse == patience || !best.sources.is_empty() && self.is_exhausted()
            {
                break;
            }
            let Some(seeds) = pencil.seeds(count) else { break };
            let mut hypothesis = Hypothesis::empty(nuisances);
            hypothesis
                .sources
                .extend(seeds.into_iter().map(|u| PointSource::new(u, 0.0)));
            self.fitter.fit(compressed, &mut hypothesis, polish);
            if self.score(&hypothesis) < self.score(best) {
                *best = hypothesis;
                worse = 0;
            } else if best.nuisances == nuisances {
                worse += 1;
            }
        }
    }

    /// A hypothesis from the pencil where spots overlap, from residual peaks elsewhere.
    pub fn initialise(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        nuisances: Nuisances,
        polish: usize,
    ) -> Hypothesis {
        self.initialise_by_pencil(compressed, nuisances, polish)
            .unwrap_or_else(|| {
                let mut dark = Hypothesis::empty(nuisances);
                self.fitter.fit(compressed, &mut dark, TRIAL_STEPS);
                self.add_residual_peaks(compressed, frame, dark)
            })
    }

    /// Refits `hypothesis` under new weights: nuisances where the frame is not explained, then proposals.
    pub fn refit_reweighted(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis, rounds: usize) {
        self.fitter.fit(compressed, hypothesis, TRIAL_STEPS);
        if !compressed.is_explained_by(hypothesis)
            && let Some(wider) = self.with_more_nuisances(compressed, hypothesis, hypothesis)
        {
            *hypothesis = wider;
        }
        self.refine(compressed, hypothesis, rounds);
        self.drop_nuisances(compressed, hypothesis);
    }

    /// The variance function, where it explains the frame better than `rival` does; only in the pixel bases.
    fn test_variance_growth(
        &mut self,
        compressed: &CompressedFrame,
        frame: &PreprocessedFrame,
        hypothesis: &mut Hypothesis,
        rival: &Hypothesis,
    ) -> Option<VarianceFunction> {
        let is_even = self.fitter.bx.is_pixels && self.fitter.by.is_pixels && compressed.weights.is_empty();
        if !self.rules().reweighting || !is_even || rival.deviance < 0.5 * hypothesis.deviance {
            return None;
        }
        let residual = self.fitter.weighted_residual(compressed, hypothesis).to_vec();
        let signal = self.fitter.expected_light(compressed, hypothesis);
        let variance = VarianceFunction::fit(
            frame,
            [compressed.rank[0], compressed.mx],
            &residual,
            &signal,
            hypothesis.sources.len(),
        );
        let nx = self.fitter.bx.n;
        let cost: f64 = (0..frame.is_masked.len())
            .filter(|&k| !frame.is_masked[k])
            .map(|k| k / nx * compressed.mx + k % nx)
            .map(|k| variance.at(signal[k]).ln() + residual[k].powi(2) / variance.at(signal[k]))
            .sum();
        let score = self.score(hypothesis) - hypothesis.deviance + cost + VarianceFunction::PENALTY;
        (score < self.score(rival)).then_some(variance)
    }
}
