//! The stages of a frame one by one, for benches that time each and studies that begin at the truth; not part of the interface.

use crate::estimate::config::KnownPower;
use crate::estimate::emitter::Emitter;
use crate::estimate::error::Error;
use crate::estimate::estimators::search_bases::bases;
use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model_order::evidence::fit_with_prior;
use crate::estimate::model_order::map_search::maximum_posterior;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::search::{SearchSpace, TRIAL_STEPS};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Steps of the joint fit that is timed.
const STEPS: usize = 5;

/// An estimator that stops between stages.
pub struct Stages {
    camera: Camera,
    space: SearchSpace,
    frame: PreprocessedFrame,
    compressed: CompressedFrame,
    hypothesis: Hypothesis,
}

impl Stages {
    pub fn new(camera: &Camera) -> Self {
        Self {
            space: SearchSpace::new(bases(camera).0, Rules::default()),
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            compressed: CompressedFrame::default(),
            hypothesis: Hypothesis::empty(Nuisances::default()),
        }
    }

    /// Validates the frame and compresses it.
    pub fn load(&mut self, frame: &Frame) -> Result<(), Error> {
        self.frame.load(frame, &self.camera)?;
        self.compressed
            .load(&self.frame, &self.space.bases.x, &self.space.bases.y);
        Ok(())
    }

    /// The matched filter of the loaded frame.
    pub fn matched_filter(&mut self) {
        let CompressedFrame {
            coefficients, mx, my, ..
        } = &self.compressed;
        self.space.matched_filter.respond(coefficients, *mx, *my);
    }

    /// Number of maxima of the matched filter after non-maximum suppression.
    pub fn peaks(&mut self) -> usize {
        self.space
            .matched_filter
            .find(self.space.source_penalty.sqrt(), 1.0)
            .len()
    }

    /// Five steps of the joint fit of the sources at `places`, m on the sensor.
    pub fn fit(&mut self, places: &[[f64; 2]]) {
        self.fit_from(places, STEPS);
    }

    fn fit_from(&mut self, places: &[[f64; 2]], steps: usize) {
        let sigma = self.camera.spot_sigma_m;
        self.hypothesis = Hypothesis::empty(Nuisances::default());
        let sources = places.iter().map(|p| PointSource::new(p.map(|v| v / sigma), 0.0));
        self.hypothesis.sources.extend(sources);
        let mut budget = WorkBudget::new(&|| false);
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budget);
        fit(&mut search.context, &mut self.hypothesis, steps);
    }

    /// The most probable hypothesis that the `map` search reaches from sources at `places`, m on the sensor: its −2 ln probability, and its
    /// emitters.
    pub fn most_probable(&mut self, known: &KnownPower, places: &[[f64; 2]]) -> (f64, Vec<Emitter>) {
        self.fit_from(places, 0);
        let prior = PowerPrior::new(known, &self.camera);
        let mut budget = WorkBudget::new(&|| false);
        let mut search = self
            .space
            .search(&self.compressed, &self.frame, &mut budget)
            .with_prior(&prior);
        let (threshold, leniency) = (f64::INFINITY, f64::INFINITY);
        let mut hypothesis = self.hypothesis.clone();
        fit_with_prior(
            &mut search.context,
            &prior,
            &mut hypothesis,
            TRIAL_STEPS,
            threshold,
            leniency,
        );
        self.hypothesis = maximum_posterior(&mut search, &prior, hypothesis);
        let score = search.score(&self.hypothesis);
        (score, self.ground())
    }

    /// Positions on the ground of what was fitted, with covariances and flags.
    pub fn ground(&mut self) -> Vec<Emitter> {
        let mut budget = WorkBudget::new(&|| false);
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budget);
        let noise_j = self.camera.noise_std_j;
        let found = localise(
            &mut search.context,
            &mut self.hypothesis,
            &self.frame,
            &self.camera,
            noise_j,
            None,
            None,
        );
        found.emitters
    }
}
