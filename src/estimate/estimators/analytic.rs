//! The estimators without a learned part: from a frame through peaks, pencil or search to positions.

use std::time::{Duration, Instant};

use crate::estimate::config::KnownPower;
use crate::estimate::detect::matrix_pencil::PencilSampler;
use crate::estimate::emitter::{Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::list::{EstimatorSpec, Method};
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::reweighting::Reweighting;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::outliers::NoiseInspection;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Reach of a spot, σ, and its share outside the basis, by which the kind of basis is chosen.
const REACH: f64 = 5.3;
const TYPICAL_TAIL: f64 = 1e-5;

/// Share of a frame's work for a first try (by the pencil, or without isolated pixels) that is not the main way.
const TRY_WORK: f64 = 0.03;

/// Share of a frame's work for the search with isolated pixels kept.
const KEPT_OUTLIERS_WORK: f64 = 0.1;
/// Passes over a frame for isolated outliers.
const OUTLIER_PASSES: usize = 3;

/// The bases to search in, and where these span the whole frame, others that leave a part to measure the noise.
pub(crate) fn bases(camera: &Camera) -> ([Basis; 2], Option<[Basis; 2]>) {
    let sigma = camera.spot_sigma_m;
    let [bx, by] = [&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma));
    let window = |b: &Basis| (2.0 * REACH / b.pitch()).min(b.n as f64);
    let data_count = (bx.rank(TYPICAL_TAIL) * by.rank(TYPICAL_TAIL)) as f64;
    // Where spots are small against the array, they touch fewer pixels than a basis has numbers.
    let has_small_spots = window(&bx) * window(&by) < 2.0 * data_count && PencilSampler::new(&bx, &by).is_none();
    if has_small_spots {
        let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma));
        (pixels, Some([bx, by]))
    } else {
        ([bx, by], None)
    }
}

/// An estimator without a learned part.
pub(crate) struct AnalyticEstimator {
    spec: &'static EstimatorSpec,
    camera: Camera,
    frame: PreprocessedFrame,
    inspection: NoiseInspection,
    /// The frame in bases that leave a part to measure the noise, where the search's own do not.
    noise_bases: Option<([Basis; 2], CompressedFrame)>,
    /// A second search that begins with the pencil, for frames that residual peaks do not explain at once; in `noise_bases` where there
    /// are any.
    pencil: Option<Search>,
    budget: Option<Duration>,
    search: Search,
    compressed: CompressedFrame,
    reweighting: Reweighting,
    prior: Option<PowerPrior>,
}

impl AnalyticEstimator {
    pub fn new(
        spec: &'static EstimatorSpec,
        camera: &Camera,
        budget: Option<Duration>,
        known: Option<&KnownPower>,
        rules: Rules,
    ) -> Self {
        let (bases, noise_bases) = bases(camera);
        let pencil = if rules.pencil_start && spec.chooses_order() {
            Search::for_pencil_start(noise_bases.as_ref().unwrap_or(&bases).clone(), rules)
        } else {
            None
        };
        let search = Search::new(bases, rules);
        let noise_bases = noise_bases.map(|bases| (bases, CompressedFrame::default()));
        Self {
            spec,
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            inspection: NoiseInspection::default(),
            noise_bases,
            pencil,
            budget,
            search,
            compressed: CompressedFrame::default(),
            reweighting: Reweighting::new(camera, rules),
            prior: known
                .filter(|_| spec.method == Method::MaximumPosterior)
                .map(|k| PowerPrior::new(k, camera)),
        }
    }

    /// Loads the frame into the search's bases; returns the measured noise in units of the configured noise.
    fn inspect(&mut self) -> f64 {
        let Self { search, compressed, .. } = self;
        let (bx, by) = (&search.fitter.bx, &search.fitter.by);
        if !self.spec.chooses_order() {
            compressed.load(&self.frame, bx, by);
            return 1.0;
        }
        match &mut self.noise_bases {
            None => {
                compressed.load(&self.frame, bx, by);
                self.inspection.run(&mut self.frame, compressed, bx, by)
            }
            Some(([cx, cy], noise_bases)) => {
                noise_bases.load(&self.frame, cx, cy);
                let scale = self.inspection.run(&mut self.frame, noise_bases, cx, cy);
                compressed.load(&self.frame, bx, by);
                (
                    compressed.variance,
                    compressed.mean_variance,
                    compressed.light_weighted_variance,
                ) = (
                    noise_bases.variance,
                    noise_bases.mean_variance,
                    noise_bases.light_weighted_variance,
                );
                scale
            }
        }
    }

    /// The hypothesis from the pencil's positions, if it explains the frame within little work.
    fn try_pencil(&mut self) -> Option<Hypothesis> {
        let compressed = self.noise_bases.as_ref().map_or(&self.compressed, |(_, r)| r);
        let search = self
            .pencil
            .as_mut()
            .filter(|s| compressed.variance.is_constant() && !s.is_heavily_masked(compressed))?;
        let limit = search.fitter.limit_work(TRY_WORK);
        let initial = search.initial_hypothesis(compressed, &self.frame);
        if !compressed.is_explained_by(&initial) {
            return None;
        }
        search.fitter.restore_work_limit(limit);
        let hypothesis = search.maximum_likelihood(compressed, &self.frame, initial);
        compressed.is_explained_by(&hypothesis).then_some(hypothesis)
    }

    /// Maximum likelihood from an initial hypothesis, with isolated outliers masked. Where the part outside the basis is white noise,
    /// outliers are more likely a misfit: they are masked only if that explains the frame at once or nothing else does.
    fn search_with_outliers(&mut self, initial: Hypothesis) -> Hypothesis {
        let is_white = self.search.rules().keep_outliers && self.inspection.is_white;
        let kept = is_white.then(|| (self.frame.clone(), self.compressed.clone()));
        let limit = self
            .search
            .fitter
            .limit_work(if is_white { TRY_WORK } else { f64::INFINITY });
        let rest = self.mask_outliers(initial.clone());
        self.search.fitter.restore_work_limit(limit);
        let Some((frame, compressed)) = kept.filter(|_| !self.compressed.is_explained_by(&rest)) else {
            return self.search.maximum_likelihood(&self.compressed, &self.frame, rest);
        };
        let frame = std::mem::replace(&mut self.frame, frame);
        let compressed = std::mem::replace(&mut self.compressed, compressed);
        let has_outliers = compressed.masked.len() > self.compressed.masked.len();
        let limit = self.search.fitter.limit_work(if has_outliers {
            KEPT_OUTLIERS_WORK
        } else {
            f64::INFINITY
        });
        let hypothesis = self.search.maximum_likelihood(&self.compressed, &self.frame, initial);
        let is_done = !self.search.is_exhausted() && self.compressed.is_explained_by(&hypothesis);
        self.search.fitter.restore_work_limit(limit);
        if !has_outliers || is_done {
            return hypothesis;
        }
        (self.frame, self.compressed) = (frame, compressed);
        self.search.maximum_likelihood(&self.compressed, &self.frame, rest)
    }

    /// The initial hypothesis after masking isolated outliers.
    fn mask_outliers(&mut self, mut initial: Hypothesis) -> Hypothesis {
        let Self { search, compressed, .. } = self;
        for _ in 0..OUTLIER_PASSES {
            if compressed.is_explained_by(&initial) {
                break;
            }
            let expected = search.fitter.expected_light(compressed, &mut initial);
            let (bx, by) = (&search.fitter.bx, &search.fitter.by);
            if !self
                .inspection
                .mask_isolated_outliers(&mut self.frame, compressed, expected, bx, by)
            {
                break;
            }
            initial = search.initial_hypothesis(compressed, &self.frame);
        }
        initial
    }
}

impl Estimator for AnalyticEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        let deadline = self.budget.map(|b| Instant::now() + b);
        self.frame.load(frame, &self.camera)?;
        let scale = self.inspect();
        self.search.reset(deadline);
        self.reweighting.search.reset(deadline);
        if let Some(pencil) = &mut self.pencil {
            pencil.reset(deadline);
        }
        let mut is_by_pencil = false;
        let is_ml = self.spec.chooses_order();
        let mut hypothesis = match self.spec.method {
            Method::Peak { is_subpixel, steps } => {
                let mut hypothesis = self.search.peaks(&self.compressed, is_subpixel);
                self.search.fitter.fit(&self.compressed, &mut hypothesis, steps);
                hypothesis
            }
            Method::Greedy => {
                let dark = Hypothesis::empty(Nuisances::default());
                let mut hypothesis = self.search.add_residual_peaks(&self.compressed, &self.frame, dark);
                self.search.propose_shrinkage(&self.compressed, &mut hypothesis);
                hypothesis
            }
            Method::Pencil { steps } => {
                let plain = Nuisances::default();
                self.search.initialise(&self.compressed, &self.frame, plain, steps)
            }
            Method::MaximumLikelihood | Method::MaximumPosterior => {
                let initial = self.search.initial_hypothesis(&self.compressed, &self.frame);
                let is_explained = self.compressed.is_explained_by(&initial);
                let by_pencil = if is_explained { None } else { self.try_pencil() };
                is_by_pencil = by_pencil.is_some();
                by_pencil.unwrap_or_else(|| self.search_with_outliers(initial))
            }
        };
        let (search, compressed) = match &mut self.pencil {
            Some(pencil) if is_by_pencil => (pencil, self.noise_bases.as_ref().map_or(&self.compressed, |(_, r)| r)),
            _ => (&mut self.search, &self.compressed),
        };
        let known = search
            .suspected_variance
            .or((!compressed.variance.is_constant()).then_some(compressed.variance));
        let is_weighted = is_ml
            && search.rules().reweighting
            && (known.is_some() || !compressed.is_explained_by(&hypothesis))
            && self.reweighting.run(&self.frame, known, &mut hypothesis);
        let (search, compressed) = if is_weighted {
            (&mut self.reweighting.search, &self.reweighting.compressed)
        } else {
            (search, compressed)
        };
        let noise_j = scale * self.camera.noise_std_j;
        let mut posterior_moments = None;
        if let Some(mut prior) = self.prior.take() {
            prior.noise_j = noise_j;
            prior.tempering = compressed.misfit(&hypothesis);
            search.prior = Some(prior);
            search.maximum_posterior(compressed, &mut hypothesis);
            self.prior = search.prior.take();
            if search.rules().posterior_mean {
                posterior_moments = search.posterior_moments(compressed, &mut hypothesis);
            }
        }
        let is_exhausted = search.is_exhausted();
        let mut estimate = localise::localise(
            search,
            compressed,
            &mut hypothesis,
            &self.frame,
            &self.camera,
            noise_j,
            posterior_moments.as_deref(),
        );
        estimate.estimator = self.spec.name;
        estimate.is_cut_short = is_exhausted;
        let by_pencil = self.pencil.as_ref().map_or(0, |pencil| pencil.fitter.steps);
        estimate.steps = by_pencil + self.search.fitter.steps + self.reweighting.search.fitter.steps;
        if is_exhausted {
            for emitter in &mut estimate.emitters {
                emitter.flags |= Flags::OUT_OF_TIME;
            }
        }
        Ok(estimate)
    }
}

impl Search {
    fn peaks(&mut self, compressed: &CompressedFrame, is_subpixel: bool) -> Hypothesis {
        let mut hypothesis = Hypothesis::empty(Nuisances::default());
        let peaks = self.matched_filter.peaks(
            &compressed.coefficients,
            compressed.mx,
            compressed.my,
            self.source_penalty.sqrt(),
            1.0,
        );
        let sources = peaks
            .iter()
            .map(|p| PointSource::new(if is_subpixel { p.u } else { p.grid }, p.a));
        hypothesis.sources.extend(sources);
        hypothesis
    }
}
