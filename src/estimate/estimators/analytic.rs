//! The estimators without a learned part: from a frame through peaks, pencil or search to positions.

use crate::estimate::config::KnownPower;
use crate::estimate::detect::segmentation::PixelSums;
use crate::estimate::emitter::{Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::frame_search::{Found, FrameSearch, SearchKind};
use crate::estimate::estimators::list::{EstimatorSpec, Method};
use crate::estimate::estimators::search_bases::bases;
use crate::estimate::estimators::spot_learner::{Lesson, SpotLearner};
use crate::estimate::estimators::width_learner::WidthLearner;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::map_search::maximum_posterior;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::search::{Search, SearchSpace};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise::localise;
use crate::estimate::uncertainty::posterior_mean::posterior_moments;
use crate::frame::Frame;
use crate::optics::{Camera, Smear};

/// An estimator without a learned part.
pub(crate) struct AnalyticEstimator {
    spec: &'static EstimatorSpec,
    camera: Camera,
    search: FrameSearch,
    /// Where the spot's shape and width may be learned.
    learner: Option<SpotLearner>,
    width: Option<WidthLearner>,
    /// While a learned shape is used: the search without it.
    configured: Option<FrameSearch>,
    prior: Option<PowerPrior>,
    rules: Rules,
}

impl AnalyticEstimator {
    pub fn new(spec: &'static EstimatorSpec, camera: &Camera, known: Option<&KnownPower>, rules: Rules) -> Self {
        let known = known.filter(|_| spec.method == Method::MaximumPosterior);
        let search = FrameSearch::new(spec, camera, rules, bases(camera));
        Self {
            spec,
            camera: camera.clone(),
            configured: None,
            learner: SpotLearner::new(camera).filter(|_| rules.learn_spots && search.history.is_some()),
            width: WidthLearner::new(camera).filter(|_| rules.learn_width && spec.chooses_order()),
            search,
            prior: known.map(|k| PowerPrior::new(k, camera)),
            rules,
        }
    }

    /// For windows of a larger sensor, in the pixel bases; `camera` is the window's, and a source has the whole sensor's `source_penalty`.
    pub fn of_window(spec: &'static EstimatorSpec, camera: &Camera, rules: Rules, source_penalty: f64) -> Self {
        let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, camera.spot_sigma_m));
        let mut search = FrameSearch::new(spec, camera, rules, (pixels, None));
        // Windows show a few spots each: the whole frame's search remembers.
        search.history = None;
        search.space.source_penalty = source_penalty;
        search.reweighting.space.source_penalty = source_penalty;
        Self {
            spec,
            camera: camera.clone(),
            search,
            learner: None,
            width: None,
            configured: None,
            prior: None,
            rules,
        }
    }
}

impl Estimator for AnalyticEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.search.frame.smear = smear.map(|s| s.displaced(&self.camera, 1.0));
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let scale = self.load(frame)?;
        Ok(self.estimate_loaded(scale, is_over))
    }
}

impl AnalyticEstimator {
    /// Validates and compresses a frame; returns the measured noise in units of the configured noise.
    pub fn load(&mut self, frame: &Frame) -> Result<f64, Error> {
        self.search.frame.load(frame, &self.camera)?;
        Ok(self.search.inspect(self.camera.quantum()))
    }

    /// Says where the next window is: its middle on the whole sensor, m, and the emitters beyond it that cast a halo into it.
    pub fn place_window(&mut self, origin_m: [f64; 2], beyond: Vec<PointSource>) {
        let search = &mut self.search;
        search.frame.beyond = beyond;
        search.space.bases.set_origin(origin_m);
        search.reweighting.space.bases.set_origin(origin_m);
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
        self.search.frame.load(frame, &self.camera)?;
        let (nx, screened) = (self.camera.x.n, &mut self.search.frame);
        exclude(&mut |x, y| screened.exclude(x, y, nx));
        self.search.compressed.spare_excess = spare_excess;
        self.search.reweighting.compressed.spare_excess = spare_excess;
        self.search.inspect(self.camera.quantum());
        let mut sums = PixelSums::default();
        let PreprocessedFrame { pixels, is_masked, .. } = &self.search.frame;
        for (p, _) in pixels.iter().zip(is_masked).filter(|(_, is_masked)| !**is_masked) {
            sums.usable += 1.0;
            sums.square += p * p;
        }
        Ok(sums)
    }

    /// Whether recent frames showed that spots differ from the PSF.
    pub fn remembers_spot_error(&self) -> bool {
        self.configured.is_some() || self.search.shown_by_recent_frames().is_some()
    }

    /// Whether the loaded window shows anything that may be an emitter.
    pub fn has_peak(&mut self) -> bool {
        let mut budget = WorkBudget::new(&|| false);
        let FrameSearch {
            space,
            compressed,
            frame,
            ..
        } = &mut self.search;
        let mut search = space.search(compressed, frame, &mut budget);
        let mut dark = Candidate::from(Hypothesis::empty(Nuisances::default()));
        !search.residual_peaks(&mut dark).is_empty()
    }

    /// The loaded frame, with the space to search it in.
    pub fn loaded(&mut self) -> (&mut SearchSpace, &CompressedFrame, &PreprocessedFrame) {
        (&mut self.search.space, &self.search.compressed, &self.search.frame)
    }

    /// What explains the loaded frame, searched again where it shows another spot than was searched for.
    fn find(&mut self, budgets: &mut Budgets) -> Found {
        let mut found = self.search.run(budgets);
        let is_told = self.spec.method != Method::Sequence && found.spot_error == 0.0;
        if is_told && self.is_width_due() && self.learn_width(found.kind, &found.hypothesis, budgets) {
            found = self.search.run(budgets);
        }
        let learner = self.learner.as_mut();
        match learner.map_or(Lesson::Nothing, |l| l.learn(&mut self.search, &found, budgets)) {
            Lesson::Nothing => return found,
            Lesson::Better(camera) => {
                let search = self.search.of_shape(&camera);
                let last = std::mem::replace(&mut self.search, search);
                self.configured.get_or_insert(last);
                self.camera = *camera;
            }
            Lesson::Wrong(camera) => {
                if let Some(configured) = self.configured.take() {
                    let last = std::mem::replace(&mut self.search, configured);
                    self.search.take_frame(last.frame, &camera);
                }
                self.camera = *camera;
            }
        }
        budgets.search.restart();
        budgets.reweighting.restart();
        self.search.run(budgets)
    }

    /// Counts a frame for the spots' width, and whether that is to be learned from it.
    pub fn is_width_due(&mut self) -> bool {
        let is_told = self.configured.is_none() && self.search.frame.smear.is_none();
        is_told && self.width.as_mut().is_some_and(WidthLearner::is_due)
    }

    /// Learns the spots' width from what explains the loaded frame. Returns whether it is to be searched again, for spots of another width.
    pub fn learn_width(&mut self, kind: SearchKind, hypothesis: &Hypothesis, budgets: &mut Budgets) -> bool {
        let Some(width) = self
            .width
            .as_mut()
            .and_then(|l| l.learn(&mut self.search.again(kind, budgets), hypothesis))
        else {
            return false;
        };
        self.take_width(width * self.camera.spot_sigma_m);
        budgets.search.restart();
        budgets.reweighting.restart();
        true
    }

    /// Searches for spots of this width, m.
    pub fn take_width(&mut self, sigma_m: f64) {
        self.camera.spot_sigma_m = sigma_m;
        self.search = self.search.of_shape(&self.camera);
        if let Some(prior) = &mut self.prior {
            prior.set_spot_sigma(sigma_m);
        }
        if let Some(learner) = &mut self.learner {
            learner.configure(&self.camera);
        }
    }

    /// The loaded frame under search.
    pub fn again<'a, 'b>(&'a mut self, budgets: &'a mut Budgets<'b>) -> Search<'a, 'b> {
        self.search.again(SearchKind::Main, budgets)
    }

    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The emitters of the loaded frame, whose noise is `scale` times the configured noise.
    pub fn estimate_loaded(&mut self, scale: f64, is_over: &dyn Fn() -> bool) -> Estimate {
        let mut budgets = Budgets::new(is_over);
        let Found {
            mut hypothesis,
            kind,
            spot_error,
            ..
        } = self.find(&mut budgets);
        let noise_j = scale * self.camera.noise_std_j;
        let mut search = self.search.again(kind, &mut budgets);
        let mut moments = None;
        if let Some(prior) = &mut self.prior {
            prior.noise_j = noise_j;
            prior.tempering = search.compressed().misfit(&hypothesis);
            let prior = &*prior;
            search = search.with_prior(prior);
            hypothesis = maximum_posterior(&mut search, prior, hypothesis);
            if self.rules.posterior_mean {
                moments = posterior_moments(&mut search.context, &mut hypothesis);
            }
        }
        let is_cut_short = search.is_exhausted();
        let frame = search.frame;
        let mut found = localise(
            &mut search.context,
            &mut hypothesis,
            frame,
            &self.camera,
            noise_j,
            moments.as_deref(),
            None,
        );
        let saturated_share = frame.saturated_share();
        let is_limited = budgets.is_limited();
        // Of the lens: what a smear's uneven light makes of spots passes with the motion.
        let is_of_lens = spot_error > self.search.compressed.unevenness;
        let of_lens = if is_of_lens {
            spot_error
        } else {
            self.search.spot_error.least()
        };
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
            spot_error: of_lens,
            saturated_share,
            condition: found.condition,
            steps: budgets.steps(),
        }
    }
}
