//! The searches of a frame: by an estimator's method, anew where the spots differ from the PSF, and anew where the noise grows with the light.

use crate::estimate::dense_linalg::largest;
use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::list::{EstimatorSpec, Method};
use crate::estimate::estimators::network_start::NetworkStart;
use crate::estimate::fit::levenberg_marquardt::{evaluate, fit};
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::ellipse_history::EllipseHistory;
use crate::estimate::model_order::initialise::{add_residual_peaks, filter_peaks, initial_hypothesis, initialise};
use crate::estimate::model_order::maximum_likelihood::maximum_likelihood;
use crate::estimate::model_order::pruning::drop_insignificant;
use crate::estimate::model_order::refine::shrink;
use crate::estimate::model_order::reweighting::Reweighting;
use crate::estimate::model_order::search::{Search, SearchSpace};
use crate::estimate::model_order::spot_error::{Shape, explained_by_width, inspect_shape};
use crate::estimate::model_order::spot_error_history::SpotErrorHistory;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::outliers::{NoiseInspection, may_hide_outliers};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::optics::{Camera, SpotError};

/// Share of a frame's work for a first try (by the pencil, or without isolated pixels) that is not the main way.
const TRY_WORK: f64 = 0.03;

/// Share of a frame's work for the search with isolated pixels kept.
const KEPT_OUTLIERS_WORK: f64 = 0.1;
/// Share of a frame's work after which it is asked whether the spots differ from the PSF: hardly a frame that can be explained takes more.
const MISFIT_WORK: f64 = 0.1;
/// Variance of the brightest pixel, in units of the noise's, from which on the noise counts as growing with the light.
const NOTICEABLE_GROWTH: f64 = 1.1;
/// Passes over a frame for isolated outliers.
const OUTLIER_PASSES: usize = 3;

/// Which of the searches a hypothesis is of.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum SearchKind {
    Main,
    Pencil,
    Reweighted,
}

/// The hypothesis of a frame.
pub(crate) struct Found {
    pub hypothesis: Hypothesis,
    pub kind: SearchKind,
    /// The share of their light by which spots may differ from the PSF, where that was allowed for.
    pub spot_error: f64,
    /// The variance function, where noise that grows with the light was suspected.
    suspected_variance: Option<VarianceFunction>,
}

impl Found {
    pub fn of(hypothesis: Hypothesis, kind: SearchKind) -> Self {
        Self {
            hypothesis,
            kind,
            spot_error: 0.0,
            suspected_variance: None,
        }
    }
}

/// A frame, and the spaces that it is searched in.
pub(crate) struct FrameSearch {
    pub spec: &'static EstimatorSpec,
    /// As configured or calibrated, or as recent frames showed.
    pub spot_error: SpotError,
    /// What recent frames showed, where it is not fixed and the sensor is wide enough to show it.
    pub history: Option<SpotErrorHistory>,
    pub ellipse: EllipseHistory,
    pub frame: PreprocessedFrame,
    inspection: NoiseInspection,
    /// The frame in bases that leave a part to measure the noise, where the search's own do not.
    noise_bases: Option<([Basis; 2], CompressedFrame)>,
    /// A second search that begins with the pencil, for frames that residual peaks do not explain at once; in `noise_bases` where there
    /// are any.
    pencil: Option<SearchSpace>,
    pub space: SearchSpace,
    pub compressed: CompressedFrame,
    pub reweighting: Reweighting,
    network_start: NetworkStart,
    rules: Rules,
}

impl FrameSearch {
    /// In these bases, and those to measure the noise in (`search_bases`).
    pub fn new(
        spec: &'static EstimatorSpec,
        camera: &Camera,
        rules: Rules,
        (bases, noise_bases): ([Basis; 2], Option<[Basis; 2]>),
    ) -> Self {
        let pencil = if rules.pencil_start && spec.chooses_order() && camera.spot_shape.is_none() {
            SearchSpace::for_pencil_start(noise_bases.as_ref().unwrap_or(&bases).clone(), rules)
        } else {
            None
        };
        let reweighting = Reweighting::new(camera, rules);
        let is_sought = !camera.spot_error.is_fixed() && spec.chooses_order() && spec.method != Method::Sequence;
        Self {
            spec,
            spot_error: camera.spot_error,
            history: (is_sought && !reweighting.space.bases.is_narrow()).then(SpotErrorHistory::default),
            ellipse: EllipseHistory::default(),
            frame: PreprocessedFrame::default(),
            inspection: NoiseInspection::default(),
            noise_bases: noise_bases.map(|bases| (bases, CompressedFrame::default())),
            pencil,
            space: SearchSpace::new(bases, rules).with_shape(camera),
            compressed: CompressedFrame::of_camera(camera),
            reweighting,
            network_start: NetworkStart::new(camera, rules.network_start && spec.chooses_order()),
            rules,
        }
    }

    /// Loads the frame into the search's bases; returns the measured noise in units of the configured noise. `quantum`: growth of the variance
    /// with the light, in the same units, where it is known.
    pub fn inspect(&mut self, quantum: Option<f64>) -> f64 {
        let scale = self.load();
        let calibrated = quantum.map(|quantum| VarianceFunction::of_quantum(quantum / scale));
        let variance = calibrated.unwrap_or(self.compressed.variance);
        let brightest = largest(0.0, &self.frame.pixels);
        self.frame.variance = if variance.at(brightest) > NOTICEABLE_GROWTH {
            variance
        } else {
            VarianceFunction::default()
        };
        scale
    }

    fn load(&mut self) -> f64 {
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

    /// The emitters of the frame.
    pub fn run(&mut self, budgets: &mut Budgets) -> Found {
        let found = self.find_as_usual(budgets);
        if self.rules.stack_misfits {
            self.stack_misfit(&found.hypothesis, budgets);
        }
        found
    }

    fn find_as_usual(&mut self, budgets: &mut Budgets) -> Found {
        if let Some(found) = self.find_with_usual_ellipse(budgets) {
            return found;
        }
        let remembered = self.shown_by_recent_frames();
        let remembered = match remembered.map(|error| self.find_as_remembered(error, budgets)) {
            Some((found, true)) => return found,
            other => other.map(|(found, _)| found),
        };
        let mut found = self.find(budgets);
        let suspected = found.suspected_variance;
        let is_simpler = self.allow_for_shape(&mut found, budgets);
        if !self.spec.chooses_order() {
            return found;
        }
        if !is_simpler {
            self.remember_shape(&mut found, budgets);
        }
        let variance = suspected.or(Some(self.frame.variance).filter(|variance| !variance.is_constant()));
        let is_noise_in_doubt =
            variance.is_some() || !self.compressed_of(found.kind).is_explained_by(&found.hypothesis);
        let is_weighted = found.spot_error > 0.0
            || is_simpler
            || self.rules.reweighting
                && is_noise_in_doubt
                && (self.reweighting).run(&self.frame, variance, &mut found.hypothesis, &mut budgets.reweighting);
        if is_weighted {
            found.kind = SearchKind::Reweighted;
        }
        if let Some(remembered) = remembered {
            self.keep_fewer(&mut found, remembered);
        }
        let is_explained = self.compressed_of(found.kind).is_explained_by(&found.hypothesis);
        if is_explained && found.spot_error == 0.0 {
            self.ellipse.push(&found.hypothesis);
        }
        found
    }

    pub fn compressed_of(&self, kind: SearchKind) -> &CompressedFrame {
        match (kind, &self.noise_bases) {
            (SearchKind::Pencil, Some((_, compressed))) => compressed,
            (SearchKind::Reweighted, _) => &self.reweighting.compressed,
            _ => &self.compressed,
        }
    }

    /// A search of the frame to go on with what was found.
    pub fn again<'a, 'b>(&'a mut self, kind: SearchKind, budgets: &'a mut Budgets<'b>) -> Search<'a, 'b> {
        let (space, compressed, budget) = match (kind, &mut self.pencil) {
            (SearchKind::Pencil, Some(pencil)) => {
                let compressed = self.noise_bases.as_ref().map_or(&self.compressed, |(_, c)| c);
                (pencil, compressed, &mut budgets.pencil)
            }
            (SearchKind::Reweighted, _) => {
                let Reweighting { space, compressed } = &mut self.reweighting;
                (space, &*compressed, &mut budgets.reweighting)
            }
            _ => (&mut self.space, &self.compressed, &mut budgets.search),
        };
        space.search(compressed, &self.frame, budget)
    }

    fn search<'a, 'b>(&'a mut self, budget: &'a mut WorkBudget<'b>) -> Search<'a, 'b> {
        self.space.search(&self.compressed, &self.frame, budget)
    }

    /// The share of their light by which the frame's spots may differ from the PSF, as far as is known before it is searched.
    pub fn least_spot_error(&self) -> f64 {
        self.spot_error.least().max(self.compressed.unevenness)
    }

    /// The frame by the estimator's method.
    pub fn find(&mut self, budgets: &mut Budgets) -> Found {
        let may_differ = self.least_spot_error() > 0.0;
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budgets.search);
        let hypothesis = match self.spec.method {
            Method::Peak { steps } => {
                let mut hypothesis = filter_peaks(&mut search);
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
                if may_differ {
                    // The search with the spot error is the only one. It starts from peaks: the pencil takes rings for sources.
                    let Reweighting { space, compressed } = &mut self.reweighting;
                    compressed.load(&self.frame, &space.bases.x, &space.bases.y);
                    let mut search = space.search(compressed, &self.frame, &mut budgets.reweighting);
                    let mut initial = Candidate::from(initial_hypothesis(&mut search));
                    drop_insignificant(&mut search, &mut initial);
                    return Found::of(initial.into_hypothesis(), SearchKind::Main);
                }
                let mut initial = initial_hypothesis(&mut search);
                let is_explained = self.compressed.is_explained_by(&initial);
                if !is_explained {
                    self.network_start.improve(&mut search, &mut initial);
                }
                let by_pencil = if is_explained {
                    None
                } else {
                    self.try_pencil(&mut budgets.pencil)
                };
                return by_pencil.unwrap_or_else(|| self.search_unless_misfit(initial, &mut budgets.search));
            }
        };
        Found::of(hypothesis, SearchKind::Main)
    }

    /// A search that ends early where the spots differ from the PSF in the same way: the frame is then searched again with that allowed for.
    /// Every other frame is searched in full, from another width where that explains it. Not where spots are all core: these show their shape
    /// in the end, if at all.
    fn search_unless_misfit(&mut self, mut initial: Hypothesis, budget: &mut WorkBudget) -> Found {
        if self.spot_error.is_fixed() || self.space.bases.is_narrow() {
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
        if !self.compressed.is_explained_by(&found.hypothesis) {
            if let Some(wider) = explained_by_width(&mut self.search(budget), &found.hypothesis) {
                initial = wider;
            } else {
                let excess = self.compressed.excess(&found.hypothesis);
                let Reweighting { space, compressed } = &mut self.reweighting;
                let shape = inspect_shape(space, compressed, &self.frame, &found.hypothesis, excess, budget);
                if matches!(shape, Shape::Different(..)) {
                    return found;
                }
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
            suspected_variance: search.suspected_variance,
            ..Found::of(hypothesis, SearchKind::Pencil)
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
            suspected_variance: search.suspected_variance,
            ..Found::of(hypothesis, SearchKind::Main)
        }
    }

    /// The initial hypothesis after masking isolated outliers.
    fn mask_outliers(&mut self, mut initial: Hypothesis, budget: &mut WorkBudget) -> Hypothesis {
        for _ in 0..OUTLIER_PASSES {
            let may_hide = may_hide_outliers(&self.compressed, self.space.bases.axes());
            if !may_hide && self.compressed.is_explained_by(&initial) {
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
