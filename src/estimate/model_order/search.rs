//! A frame under search: what hypotheses are fitted to, compared by and proposed from, and the step that every proposal ends in: fit,
//! compare, accept.

use crate::estimate::detect::matched_filter::{MatchedFilter, Peak};
use crate::estimate::detect::matrix_pencil::PencilSampler;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::{fit, fit_below};
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Background, Hypothesis, Nuisances, OVERLAPPING, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::criterion::{Criterion, source_penalty};
use crate::estimate::model_order::evidence::fit_with_prior;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::optics::Camera;

/// Steps of a candidate's fit before it is compared: few, as most candidates are rejected; those accepted converge later.
pub(crate) const TRIAL_STEPS: usize = 30;
/// Steps of the last fit before a hypothesis is reported; curved valleys of overlapping sources take many.
const CONVERGE_STEPS: usize = 200;
/// A source is first assigned to a user unless −2 ln probability rises by more than this: a start's energies are off by eight standard
/// deviations at most, and what is wrong is corrected after the fit.
pub(crate) const ASSIGNMENT_SLACK: f64 = 60.0;
/// Largest masked fraction for which the matrix pencil and rotated ellipses are used: the pencil sees the fill values. Above
/// the share of dead pixels of the trade-off's cells, 1 %, where the pencil is as good as without.
const MAX_MASKED_SHARE: f64 = 0.03;

/// What searches of one frame after another share: the bases, the detectors made for them, scratch memory.
pub(crate) struct SearchSpace {
    pub bases: Bases,
    pub matched_filter: MatchedFilter,
    /// The matrix pencil, where spots are wide enough against the sensor.
    pencil: Option<PencilSampler>,
    /// Least decrease of the deviance for a source.
    pub source_penalty: f64,
    pub rules: Rules,
    pub workspace: Workspace,
}

impl SearchSpace {
    pub fn new([bx, by]: [Basis; 2], rules: Rules) -> Self {
        let pencil = PencilSampler::new(&bx, &by);
        Self::with(pencil, [bx, by], rules)
    }

    /// The same with the PSF that the camera was measured to have, if it was; in pixel bases.
    pub fn with_shape(mut self, camera: &Camera) -> Self {
        self.bases = self.bases.with_shape(camera);
        self
    }

    /// For a first try by the pencil where [`SearchSpace::new`] begins with residual peaks.
    pub fn for_pencil_start([bx, by]: [Basis; 2], rules: Rules) -> Option<Self> {
        let pencil = PencilSampler::for_pencil_start(&bx, &by)?;
        Some(Self::with(Some(pencil), [bx, by], rules))
    }

    fn with(pencil: Option<PencilSampler>, bases: [Basis; 2], rules: Rules) -> Self {
        let bases = Bases::new(bases);
        Self {
            matched_filter: MatchedFilter::new(&bases.x, &bases.y),
            pencil,
            source_penalty: source_penalty(bases.axes().map(|b| b.edges[b.n] - b.edges[0])),
            rules,
            workspace: Workspace::default(),
            bases,
        }
    }

    /// A search of one frame by the penalised likelihood. `compressed` is `frame` in the space's bases.
    pub fn search<'a, 'b>(
        &'a mut self,
        compressed: &'a CompressedFrame,
        frame: &'a PreprocessedFrame,
        budget: &'a mut WorkBudget<'b>,
    ) -> Search<'a, 'b> {
        Search {
            criterion: Criterion {
                source_penalty: self.source_penalty,
                noise_inflation: compressed.light_weighted_variance,
                prior: None,
            },
            context: FitContext {
                bases: &self.bases,
                compressed,
                rules: self.rules,
                budget,
                workspace: &mut self.workspace,
            },
            frame,
            matched_filter: &mut self.matched_filter,
            pencil: self.pencil.as_mut(),
            suspected_variance: None,
        }
    }
}

/// The search for the number of sources in one frame.
pub(crate) struct Search<'a, 'b> {
    pub context: FitContext<'a, 'b>,
    pub frame: &'a PreprocessedFrame,
    pub criterion: Criterion<'a>,
    pub matched_filter: &'a mut MatchedFilter,
    pub pencil: Option<&'a mut PencilSampler>,
    /// The variance function, where noise that grows with the light explains the frame better than more sources.
    pub suspected_variance: Option<VarianceFunction>,
}

impl<'a> Search<'a, '_> {
    /// The same search by the evidence under a prior of energies.
    pub fn with_prior(mut self, prior: &'a PowerPrior) -> Self {
        self.criterion.prior = Some(prior);
        self
    }

    pub fn compressed(&self) -> &'a CompressedFrame {
        self.context.compressed
    }

    pub fn rules(&self) -> Rules {
        self.context.rules
    }

    pub fn is_exhausted(&self) -> bool {
        self.context.budget.is_exhausted()
    }

    pub fn score(&self, hypothesis: &Hypothesis) -> f64 {
        self.criterion.score(hypothesis)
    }

    /// Whether the noise alone explains what a hypothesis leaves.
    pub fn is_explained_by(&self, hypothesis: &Hypothesis) -> bool {
        self.compressed().is_explained_by(hypothesis)
    }

    /// Whether the PSF is measured: then it has no width to be fitted.
    pub fn is_measured(&self) -> bool {
        self.context.bases.shape.is_some()
    }

    /// The background that the dark parts of the frame show. A fainter one shows in the residual.
    pub fn visible_background(&self) -> Background {
        if !self.frame.has_visible_background() {
            Background::None
        } else if self.context.bases.is_curved_by_spots() {
            Background::Plane
        } else {
            Background::Curved
        }
    }

    /// A width with the background that may be there.
    pub fn with_background(&self, width: Width) -> Nuisances {
        Nuisances {
            background: self.visible_background().max(Background::Plane),
            width,
        }
    }

    /// Whether too many pixels are masked for the matrix pencil and for rotated ellipses.
    pub fn is_heavily_masked(&self) -> bool {
        let pixels = self.context.bases.x.n * self.context.bases.y.n;
        self.compressed().masked.len() as f64 > MAX_MASKED_SHARE * pixels as f64
    }

    /// Fits for a comparison.
    pub fn fit_trial(&mut self, hypothesis: &mut Hypothesis) {
        fit(&mut self.context, hypothesis, TRIAL_STEPS);
    }

    /// Fits to convergence.
    pub fn converge(&mut self, candidate: &mut Candidate) {
        if !candidate.converged {
            fit(&mut self.context, candidate, CONVERGE_STEPS);
        }
    }

    /// Fits `next` under the criterion, and no further than it can score better than `rival`.
    pub fn fit_against(&mut self, rival: &Hypothesis, next: &mut Hypothesis) {
        let threshold = self.criterion.acceptance_threshold(rival, next);
        match self.criterion.prior {
            None => {
                fit_below(&mut self.context, next, TRIAL_STEPS, threshold);
            }
            Some(prior) => fit_with_prior(&mut self.context, prior, next, TRIAL_STEPS, threshold, ASSIGNMENT_SLACK),
        }
    }

    /// Fits `next` and keeps it if it scores better.
    pub fn try_accept(&mut self, candidate: &mut Candidate, mut next: Hypothesis) -> bool {
        if next.sources.len() > self.compressed().max_sources() {
            self.context.budget.is_limited = true;
            return false;
        }
        if self.is_exhausted() {
            return false;
        }
        self.fit_against(candidate, &mut next);
        let is_better = self.score(&next) < self.score(candidate) - 1e-6;
        if is_better {
            *candidate = next.into();
        }
        is_better
    }

    /// Keeps `next`, which is fitted, if it scores better.
    pub fn keep_better(&self, candidate: &mut Candidate, next: Candidate) {
        if self.score(&next) < self.score(candidate) {
            *candidate = next;
        }
    }

    /// Peaks of the residual, the most significant first. The part of a peak that other sources have absorbed comes back in the joint
    /// fit: the threshold is lower than a source's penalty.
    pub fn residual_peaks(&mut self, candidate: &mut Candidate) -> Vec<Peak> {
        let (mx, my) = (self.compressed().mx, self.compressed().my);
        let threshold = 0.7 * self.criterion.threshold().sqrt();
        let compressed = self.compressed();
        let residual = &candidate.evaluation(&mut self.context).residual;
        if compressed.has_spot_error() {
            let size = [mx, my];
            return (self.matched_filter)
                .weighted_peaks(residual, &compressed.weights, size, threshold, OVERLAPPING)
                .to_vec();
        }
        self.matched_filter
            .peaks(residual, mx, my, threshold, OVERLAPPING)
            .to_vec()
    }
}
