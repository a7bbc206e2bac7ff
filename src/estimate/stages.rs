//! The stages of a frame one by one, so that a bench can time each and a test begin at the truth; not part of the interface.

use crate::estimate::config::KnownPower;
use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot};
use crate::estimate::model_order::power_prior::Prior;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::screening::Screened;
use crate::estimate::uncertainty::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Steps of the joint fit that is timed.
const STEPS: usize = 5;

/// A frame's way from pixels to positions, halted between stages.
pub struct Stages {
    camera: Camera,
    search: Search,
    frame: Screened,
    reading: Reading,
    model: Model,
}

impl Stages {
    pub fn new(camera: &Camera) -> Self {
        Self {
            search: Search::new(crate::estimate::estimators::analytic::bases(camera).0),
            camera: camera.clone(),
            frame: Screened::default(),
            reading: Reading::default(),
            model: Model::empty(Nuisances::default()),
        }
    }

    /// Validates the frame and brings it into the bases.
    pub fn load(&mut self, frame: &Frame) -> Result<(), Error> {
        self.frame.load(frame, &self.camera)?;
        let fitter = &self.search.fitter;
        self.reading.load(&self.frame, &fitter.bx, &fitter.by);
        Ok(())
    }

    /// The matched filter of the loaded frame.
    pub fn heatmap(&mut self) {
        let Reading { z, mx, my, .. } = &self.reading;
        self.search.heatmap.respond(z, *mx, *my);
    }

    /// Maxima of the heatmap, suppressed within a spot's radius and placed between grid points; how many.
    pub fn peaks(&mut self) -> usize {
        self.search.heatmap.find(self.search.price.sqrt(), 1.0).len()
    }

    /// Five steps of the joint fit of the spots at `places`, m on the sensor.
    pub fn fit(&mut self, places: &[[f64; 2]]) {
        self.fit_from(places, STEPS);
    }

    fn fit_from(&mut self, places: &[[f64; 2]], steps: usize) {
        let sigma = self.camera.spot_sigma_m;
        self.model = Model::empty(Nuisances::default());
        let spots = places.iter().map(|p| Spot::new(p.map(|v| v / sigma), 0.0));
        self.model.spots.extend(spots);
        self.search.restart(None);
        self.search.fitter.fit(&self.reading, &mut self.model, steps);
    }

    /// −2 ln of the posterior probability of what `map` makes of spots at `places`, m on the sensor, and that.
    pub fn most_probable(&mut self, known: &KnownPower, places: &[[f64; 2]]) -> (f64, Estimate) {
        self.fit_from(places, 0);
        self.search.prior = Some(Prior::new(known, &self.camera));
        self.search
            .weigh_up(&self.reading, &mut self.model, f64::INFINITY, f64::INFINITY);
        self.search.maximum_posterior(&self.reading, &mut self.model);
        let score = self.search.score(&self.model);
        self.search.prior = None;
        (score, self.ground())
    }

    /// Positions on the ground of what was fitted, with covariances and flags.
    pub fn ground(&mut self) -> Estimate {
        let Self {
            camera,
            search,
            frame,
            reading,
            model,
        } = self;
        localise::locate(search, reading, model, frame, camera, camera.noise_std_j, None)
    }
}
