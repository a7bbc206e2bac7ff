//! The stages of a frame one by one, for benches that time each and studies that begin at the truth; not part of the interface.

use crate::estimate::config::KnownPower;
use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Steps of the joint fit that is timed.
const STEPS: usize = 5;

/// An estimator that stops between stages.
pub struct Stages {
    camera: Camera,
    search: Search,
    frame: PreprocessedFrame,
    compressed: CompressedFrame,
    hypothesis: Hypothesis,
}

impl Stages {
    pub fn new(camera: &Camera) -> Self {
        Self {
            search: Search::new(crate::estimate::estimators::analytic::bases(camera).0, Rules::default()),
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            compressed: CompressedFrame::default(),
            hypothesis: Hypothesis::empty(Nuisances::default()),
        }
    }

    /// Validates the frame and compresses it.
    pub fn load(&mut self, frame: &Frame) -> Result<(), Error> {
        self.frame.load(frame, &self.camera)?;
        let fitter = &self.search.fitter;
        self.compressed.load(&self.frame, &fitter.bx, &fitter.by);
        Ok(())
    }

    /// The matched filter of the loaded frame.
    pub fn matched_filter(&mut self) {
        let CompressedFrame {
            coefficients, mx, my, ..
        } = &self.compressed;
        self.search.matched_filter.respond(coefficients, *mx, *my);
    }

    /// Number of maxima of the matched filter after non-maximum suppression.
    pub fn peaks(&mut self) -> usize {
        self.search
            .matched_filter
            .find(self.search.source_penalty.sqrt(), 1.0)
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
        self.search.reset(None);
        self.search.fitter.fit(&self.compressed, &mut self.hypothesis, steps);
    }

    /// The most probable hypothesis that the `map` search reaches from sources at `places`, m on the sensor: its −2 ln probability, and its
    /// emitters.
    pub fn most_probable(&mut self, known: &KnownPower, places: &[[f64; 2]]) -> (f64, Estimate) {
        self.fit_from(places, 0);
        self.search.prior = Some(PowerPrior::new(known, &self.camera));
        self.search
            .fit_with_prior(&self.compressed, &mut self.hypothesis, f64::INFINITY, f64::INFINITY);
        self.search.maximum_posterior(&self.compressed, &mut self.hypothesis);
        let score = self.search.score(&self.hypothesis);
        self.search.prior = None;
        (score, self.ground())
    }

    /// Positions on the ground of what was fitted, with covariances and flags.
    pub fn ground(&mut self) -> Estimate {
        let Self {
            camera,
            search,
            frame,
            compressed,
            hypothesis,
        } = self;
        localise::localise(search, compressed, hypothesis, frame, camera, camera.noise_std_j, None)
    }
}
