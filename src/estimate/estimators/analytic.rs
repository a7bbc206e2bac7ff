//! The estimators without a learned part: from a frame through peaks, pencil or search to positions.

use crate::estimate::config::KnownPower;
use crate::estimate::detect::matrix_pencil::PencilSampler;
use crate::estimate::detect::segmentation::PixelSums;
use crate::estimate::emitter::{Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::list::{EstimatorSpec, Method};
use crate::estimate::fit::levenberg_marquardt::{evaluate, fit};
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::common_misfit::is_narrow;
use crate::estimate::model_order::initialise::{add_residual_peaks, initial_hypothesis, initialise};
use crate::estimate::model_order::map_search::maximum_posterior;
use crate::estimate::model_order::maximum_likelihood::maximum_likelihood;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::refine::shrink;
use crate::estimate::model_order::reweighting::Reweighting;
use crate::estimate::model_order::search::{Search, SearchSpace};
use crate::estimate::model_order::spot_error::{Shape, drop_halo, inspect_shape, search_with_spot_error};
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::outliers::NoiseInspection;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise::localise;
use crate::estimate::uncertainty::posterior_mean::posterior_moments;
use crate::frame::Frame;
use crate::optics::{Camera, Smear};

/// Reach of a spot, σ, and its share outside the basis, by which the kind of basis is chosen.
const REACH: f64 = 5.3;
const TYPICAL_TAIL: f64 = 1e-5;

/// Share of a frame's work for a first try (by the pencil, or without isolated pixels) that is not the main way.
const TRY_WORK: f64 = 0.03;

/// Share of a frame's work for the search with isolated pixels kept.
const KEPT_OUTLIERS_WORK: f64 = 0.1;
/// Share of a frame's work after which it is asked whether the spots differ from the PSF: hardly a frame that can be explained takes more.
const MISFIT_WORK: f64 = 0.1;
/// Passes over a frame for isolated outliers.
const OUTLIER_PASSES: usize = 3;

/// The bases to search in, and where these span the whole frame, others that leave a part to measure the noise.
pub(crate) fn bases(camera: &Camera) -> ([Basis; 2], Option<[Basis; 2]>) {
    let sigma = camera.spot_sigma_m;
    if camera.spot_shape.is_some() {
        return ([&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma)), None);
    }
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
    pencil: Option<SearchSpace>,
    space: SearchSpace,
    compressed: CompressedFrame,
    reweighting: Reweighting,
    prior: Option<PowerPrior>,
    rules: Rules,
}

/// What each of a frame's searches may spend.
struct Budgets<'a> {
    search: WorkBudget<'a>,
    pencil: WorkBudget<'a>,
    reweighting: WorkBudget<'a>,
}

/// The hypothesis of a frame and the search that it is of.
struct Found {
    hypothesis: Hypothesis,
    is_by_pencil: bool,
    /// The variance function, where noise that grows with the light was suspected.
    suspected_variance: Option<VarianceFunction>,
}

impl AnalyticEstimator {
    pub fn new(spec: &'static EstimatorSpec, camera: &Camera, known: Option<&KnownPower>, rules: Rules) -> Self {
        Self::with_bases(spec, camera, known, rules, bases(camera))
    }

    /// For windows of a larger sensor, in the pixel bases; `camera` is the window's, and a source has the whole sensor's `source_penalty`.
    pub fn of_window(spec: &'static EstimatorSpec, camera: &Camera, rules: Rules, source_penalty: f64) -> Self {
        let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, camera.spot_sigma_m));
        let mut estimator = Self::with_bases(spec, camera, None, rules, (pixels, None));
        estimator.space.source_penalty = source_penalty;
        estimator.reweighting.space.source_penalty = source_penalty;
        estimator
    }

    fn with_bases(
        spec: &'static EstimatorSpec,
        camera: &Camera,
        known: Option<&KnownPower>,
        rules: Rules,
        (bases, noise_bases): ([Basis; 2], Option<[Basis; 2]>),
    ) -> Self {
        let pencil = if rules.pencil_start && spec.chooses_order() && camera.spot_shape.is_none() {
            SearchSpace::for_pencil_start(noise_bases.as_ref().unwrap_or(&bases).clone(), rules)
        } else {
            None
        };
        Self {
            spec,
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            inspection: NoiseInspection::default(),
            noise_bases: noise_bases.map(|bases| (bases, CompressedFrame::default())),
            pencil,
            space: SearchSpace::new(bases, rules).with_shape(camera),
            compressed: CompressedFrame::of_camera(camera),
            reweighting: Reweighting::new(camera, rules),
            prior: known
                .filter(|_| spec.method == Method::MaximumPosterior)
                .map(|k| PowerPrior::new(k, camera)),
            rules,
        }
    }

    /// Loads the frame into the search's bases; returns the measured noise in units of the configured noise.
    fn inspect(&mut self) -> f64 {
        let Self { space, compressed, .. } = self;
        let (bx, by) = (&space.bases.x, &space.bases.y);
        if !self.spec.chooses_order() {
            compressed.load(&self.frame, bx, by);
            return 1.0;
        }
        match &mut self.noise_bases {
            None => {
                compressed.load(&self.frame, bx, by);
                self.inspection.run(&mut self.frame, compressed, bx, by)
            }
            Some(([cx, cy], in_noise_bases)) => {
                in_noise_bases.load(&self.frame, cx, cy);
                let scale = self.inspection.run(&mut self.frame, in_noise_bases, cx, cy);
                compressed.load(&self.frame, bx, by);
                compressed.variance = in_noise_bases.variance;
                compressed.mean_variance = in_noise_bases.mean_variance;
                compressed.light_weighted_variance = in_noise_bases.light_weighted_variance;
                scale
            }
        }
    }

    fn search<'a, 'b>(&'a mut self, budget: &'a mut WorkBudget<'b>) -> Search<'a, 'b> {
        self.space.search(&self.compressed, &self.frame, budget)
    }

    /// The frame by the estimator's method.
    fn find(&mut self, budgets: &mut Budgets) -> Found {
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budgets.search);
        let hypothesis = match self.spec.method {
            Method::Peak { steps } => {
                let mut hypothesis = peaks(&mut search);
                fit(&mut search.context, &mut hypothesis, steps);
                hypothesis
            }
            Method::Greedy => {
                let dark = Candidate::from(Hypothesis::empty(Nuisances::default()));
                let mut candidate = add_residual_peaks(&mut search, dark);
                shrink(&mut search, &mut candidate);
                candidate.into_hypothesis()
            }
            Method::Pencil { steps } => initialise(&mut search, Nuisances::default(), steps).into_hypothesis(),
            Method::MaximumLikelihood | Method::MaximumPosterior | Method::Sequence => {
                let initial = initial_hypothesis(&mut search);
                if self.camera.spot_error.is_some_and(|e| e > 0.0) && self.space.bases.are_pixels() {
                    // The search with the spot error is the only one.
                    return Found {
                        hypothesis: initial,
                        is_by_pencil: false,
                        suspected_variance: None,
                    };
                }
                let is_explained = self.compressed.is_explained_by(&initial);
                let by_pencil = if is_explained {
                    None
                } else {
                    self.try_pencil(&mut budgets.pencil)
                };
                return by_pencil.unwrap_or_else(|| self.search_unless_misfit(initial, &mut budgets.search));
            }
        };
        Found {
            hypothesis,
            is_by_pencil: false,
            suspected_variance: None,
        }
    }

    /// A search that ends early where the spots differ from the PSF in the same way: the frame is then searched again with that allowed for.
    /// Every other frame is searched in full. Not where spots are all core: these show their shape in the end, if at all.
    fn search_unless_misfit(&mut self, initial: Hypothesis, budget: &mut WorkBudget) -> Found {
        if self.camera.spot_error.is_some() || is_narrow(&self.space.bases) {
            return self.search_with_outliers(initial, budget);
        }
        let kept = (self.frame.clone(), self.compressed.clone());
        let limit = budget.limit(MISFIT_WORK);
        let found = self.search_with_outliers(initial.clone(), budget);
        let is_complete = budget.was_ample();
        budget.restore_limit(limit);
        if is_complete {
            return found;
        }
        let excess = self.compressed.excess(&found.hypothesis);
        if !self.compressed.is_explained_by(&found.hypothesis) {
            let Reweighting { space, compressed } = &mut self.reweighting;
            let shape = inspect_shape(space, compressed, &self.frame, &found.hypothesis, excess, budget);
            if matches!(shape, Shape::Different(..)) {
                return found;
            }
        }
        (self.frame, self.compressed) = kept;
        budget.restart();
        self.search_with_outliers(initial, budget)
    }

    /// The hypothesis from the pencil's positions, if it explains the frame within little work.
    fn try_pencil(&mut self, budget: &mut WorkBudget) -> Option<Found> {
        let compressed = self.noise_bases.as_ref().map_or(&self.compressed, |(_, r)| r);
        let mut search = self.pencil.as_mut()?.search(compressed, &self.frame, budget);
        if !compressed.variance.is_constant() || search.is_heavily_masked() {
            return None;
        }
        let limit = search.context.budget.limit(TRY_WORK);
        let initial = initial_hypothesis(&mut search);
        if !compressed.is_explained_by(&initial) {
            return None;
        }
        search.context.budget.restore_limit(limit);
        let hypothesis = maximum_likelihood(&mut search, initial);
        compressed.is_explained_by(&hypothesis).then_some(Found {
            hypothesis,
            is_by_pencil: true,
            suspected_variance: search.suspected_variance,
        })
    }

    /// Maximum likelihood from an initial hypothesis, with isolated outliers masked. Where the part outside the basis is white noise,
    /// outliers are more likely a misfit: they are masked only if that explains the frame at once or nothing else does.
    fn search_with_outliers(&mut self, initial: Hypothesis, budget: &mut WorkBudget) -> Found {
        let is_white = self.rules.keep_outliers && self.inspection.is_white;
        let kept = is_white.then(|| (self.frame.clone(), self.compressed.clone()));
        let limit = budget.limit(if is_white { TRY_WORK } else { f64::INFINITY });
        let rest = self.mask_outliers(initial.clone(), budget);
        budget.restore_limit(limit);
        let Some(kept) = kept.filter(|_| !self.compressed.is_explained_by(&rest)) else {
            return self.maximum_likelihood(rest, budget);
        };
        let masked = (
            std::mem::replace(&mut self.frame, kept.0),
            std::mem::replace(&mut self.compressed, kept.1),
        );
        let has_outliers = masked.1.masked.len() > self.compressed.masked.len();
        let limit = budget.limit(if has_outliers {
            KEPT_OUTLIERS_WORK
        } else {
            f64::INFINITY
        });
        let found = self.maximum_likelihood(initial, budget);
        let is_done = !budget.is_exhausted() && self.compressed.is_explained_by(&found.hypothesis);
        budget.restore_limit(limit);
        if !has_outliers || is_done {
            return found;
        }
        (self.frame, self.compressed) = masked;
        self.maximum_likelihood(rest, budget)
    }

    fn maximum_likelihood(&mut self, initial: Hypothesis, budget: &mut WorkBudget) -> Found {
        let mut search = self.search(budget);
        let hypothesis = maximum_likelihood(&mut search, initial);
        Found {
            hypothesis,
            is_by_pencil: false,
            suspected_variance: search.suspected_variance,
        }
    }

    /// The initial hypothesis after masking isolated outliers.
    fn mask_outliers(&mut self, mut initial: Hypothesis, budget: &mut WorkBudget) -> Hypothesis {
        for _ in 0..OUTLIER_PASSES {
            if self.compressed.is_explained_by(&initial) {
                break;
            }
            let mut search = self.search(budget);
            let expected = evaluate(&mut search.context, &mut initial).expected_light();
            let (bx, by) = (&self.space.bases.x, &self.space.bases.y);
            let has_outliers =
                self.inspection
                    .mask_isolated_outliers(&mut self.frame, &mut self.compressed, expected, bx, by);
            if !has_outliers {
                break;
            }
            initial = initial_hypothesis(&mut self.search(budget));
        }
        initial
    }
}

impl Estimator for AnalyticEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.frame.smear = smear.map(|s| s.displaced(&self.camera, 1.0));
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let scale = self.load(frame)?;
        Ok(self.estimate_loaded(scale, is_over))
    }
}

impl AnalyticEstimator {
    /// Validates and compresses a frame; returns the measured noise in units of the configured noise.
    pub fn load(&mut self, frame: &Frame) -> Result<f64, Error> {
        self.frame.load(frame, &self.camera)?;
        Ok(self.inspect())
    }

    /// Loads a window of a frame whose pixels have this noise, without its foreign pixels, of which `exclude` lists those of one window.
    /// `spare_excess`: see [`CompressedFrame`].
    pub fn load_window(
        &mut self,
        frame: &Frame,
        exclude: impl FnOnce(&mut dyn FnMut(usize, usize)),
        noise_std_j: f64,
        spare_excess: f64,
    ) -> Result<PixelSums, Error> {
        self.camera.noise_std_j = noise_std_j;
        self.frame.load(frame, &self.camera)?;
        let (nx, screened) = (self.camera.x.n, &mut self.frame);
        exclude(&mut |x, y| screened.exclude(x, y, nx));
        self.compressed.spare_excess = spare_excess;
        self.reweighting.compressed.spare_excess = spare_excess;
        self.inspect();
        let mut sums = PixelSums::default();
        let masked = self.frame.is_masked.iter();
        for (p, _) in self
            .frame
            .pixels
            .iter()
            .zip(masked)
            .filter(|(_, is_masked)| !**is_masked)
        {
            sums.usable += 1.0;
            sums.square += p * p;
        }
        Ok(sums)
    }

    /// Whether the loaded window shows anything that may be an emitter.
    pub fn has_peak(&mut self) -> bool {
        let mut budget = WorkBudget::new(&|| false);
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budget);
        let mut dark = Candidate::from(Hypothesis::empty(Nuisances::default()));
        !search.residual_peaks(&mut dark).is_empty()
    }

    /// The loaded frame, with the space to search it in.
    pub fn loaded(&mut self) -> (&mut SearchSpace, &CompressedFrame, &PreprocessedFrame) {
        (&mut self.space, &self.compressed, &self.frame)
    }

    /// The emitters of the loaded frame, whose noise is `scale` times the configured noise.
    pub fn estimate_loaded(&mut self, scale: f64, is_over: &dyn Fn() -> bool) -> Estimate {
        let mut budgets = Budgets {
            search: WorkBudget::new(is_over),
            pencil: WorkBudget::new(is_over),
            reweighting: WorkBudget::new(is_over),
        };
        let Found {
            mut hypothesis,
            is_by_pencil,
            suspected_variance,
        } = self.find(&mut budgets);
        let (space, compressed, budget) = match &mut self.pencil {
            Some(pencil) if is_by_pencil => {
                let compressed = self.noise_bases.as_ref().map_or(&self.compressed, |(_, r)| r);
                (pencil, compressed, &mut budgets.pencil)
            }
            _ => (&mut self.space, &self.compressed, &mut budgets.search),
        };
        let mut spot_error = 0.0;
        let mut is_simpler = false;
        if self.spec.chooses_order() {
            let is_explained = compressed.is_explained_by(&hypothesis);
            let excess = compressed.excess(&hypothesis);
            let Reweighting { space, compressed } = &mut self.reweighting;
            let (frame, budget) = (&self.frame, &mut budgets.reweighting);
            let shape = match self.camera.spot_error {
                Some(0.0) => Shape::AsModelled,
                Some(error) => Shape::of_spot_error(error, &hypothesis),
                None => inspect_shape(space, compressed, frame, &hypothesis, excess, budget),
            };
            match shape {
                Shape::AsModelled => {}
                Shape::Simpler(simpler) => {
                    hypothesis = simpler;
                    is_simpler = true;
                }
                Shape::Different(error, bright) => {
                    let next = search_with_spot_error(space, compressed, frame, error, bright, budget);
                    let is_simpler = next.sources.len() < hypothesis.sources.len() && compressed.is_explained_by(&next);
                    if !is_explained || is_simpler || self.camera.spot_error.is_some() {
                        hypothesis = next;
                        spot_error = error;
                    }
                }
            }
        } else if let Some(error) = self.camera.spot_error.filter(|e| *e > 0.0) {
            drop_halo(&space.bases, error, space.source_penalty, &mut hypothesis.sources);
            spot_error = error;
        }
        let variance = suspected_variance.or((!compressed.variance.is_constant()).then_some(compressed.variance));
        let is_weighted = self.spec.chooses_order() && (spot_error > 0.0 || is_simpler)
            || self.rules.reweighting
                && self.spec.chooses_order()
                && (variance.is_some() || !compressed.is_explained_by(&hypothesis))
                && self
                    .reweighting
                    .run(&self.frame, variance, &mut hypothesis, &mut budgets.reweighting);
        let (space, compressed, budget) = if is_weighted {
            let Reweighting { space, compressed } = &mut self.reweighting;
            (space, &*compressed, &mut budgets.reweighting)
        } else {
            (space, compressed, budget)
        };
        let noise_j = scale * self.camera.noise_std_j;
        let mut search = space.search(compressed, &self.frame, budget);
        let mut moments = None;
        if let Some(prior) = &mut self.prior {
            prior.noise_j = noise_j;
            prior.tempering = compressed.misfit(&hypothesis);
            let prior = &*prior;
            search = search.with_prior(prior);
            hypothesis = maximum_posterior(&mut search, prior, hypothesis);
            if self.rules.posterior_mean {
                moments = posterior_moments(&mut search.context, &mut hypothesis);
            }
        }
        let is_cut_short = search.is_exhausted();
        let mut found = localise(
            &mut search.context,
            &mut hypothesis,
            &self.frame,
            &self.camera,
            noise_j,
            moments.as_deref(),
            None,
        );
        let is_limited = [&budgets.search, &budgets.pencil, &budgets.reweighting]
            .iter()
            .any(|b| b.is_limited);
        let mut flags = Flags::empty();
        flags.set(Flags::OUT_OF_TIME, is_cut_short);
        flags.set(Flags::LIMIT_REACHED, is_limited);
        for emitter in &mut found.emitters {
            emitter.flags |= flags;
        }
        Estimate {
            emitters: found.emitters,
            estimator: self.spec.name,
            is_cut_short,
            is_limited,
            reduced_chi2: found.reduced_chi2,
            spot_error,
            saturated_share: self.frame.saturated_share(),
            condition: found.condition,
            steps: budgets.search.steps + budgets.pencil.steps + budgets.reweighting.steps,
        }
    }
}

/// The matched filter's maxima as sources.
fn peaks(search: &mut Search) -> Hypothesis {
    let compressed = search.compressed();
    let peaks = search.matched_filter.peaks(
        &compressed.coefficients,
        compressed.mx,
        compressed.my,
        search.criterion.source_penalty.sqrt(),
        1.0,
    );
    let mut hypothesis = Hypothesis::empty(Nuisances::default());
    hypothesis
        .sources
        .extend(peaks.iter().map(|p| PointSource::new(p.u, p.a)));
    hypothesis
}
