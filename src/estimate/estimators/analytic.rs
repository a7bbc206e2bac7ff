//! The rungs without a learned part: from a frame through peaks, pencil or search to positions.

use std::time::{Duration, Instant};

use crate::estimate::config::KnownPower;
use crate::estimate::detect::matrix_pencil::Sampler;
use crate::estimate::emitter::{Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::list::{Method, Rung};
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::power_prior::Prior;
use crate::estimate::model_order::reweighting::Weighing;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::outliers::Inspection;
use crate::estimate::preprocess::screening::Screened;
use crate::estimate::uncertainty::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Reach of a spot in σ and share of it outside the basis by which a camera is judged.
const REACH: f64 = 5.3;
const TYPICAL: f64 = 1e-5;

/// Share of a frame's work that the pencil's look may take where it is not the main way.
const SHORT: f64 = 0.03;

/// Share of a frame's work that is tried with pixels in it which may be lit alone.
const TRIAL: f64 = 0.1;
/// Times that a frame is looked over for pixels that are lit alone.
const LOOKS: usize = 3;

/// The bases to search in, and others that leave room for noise alone where those leave none.
pub(crate) fn bases(camera: &Camera) -> ([Basis; 2], Option<[Basis; 2]>) {
    let sigma = camera.spot_sigma_m;
    let [bx, by] = [&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma));
    let window = |b: &Basis| (2.0 * REACH / b.pitch()).min(b.n as f64);
    let numbers = (bx.rank(TYPICAL) * by.rank(TYPICAL)) as f64;
    // Where spots are small against the array, they touch fewer pixels than a basis has numbers.
    let has_small_spots = window(&bx) * window(&by) < 2.0 * numbers && Sampler::new(&bx, &by).is_none();
    if has_small_spots {
        let pixels = [&camera.x, &camera.y].map(|axis| Basis::pixels(axis, sigma));
        (pixels, Some([bx, by]))
    } else {
        ([bx, by], None)
    }
}

/// A rung without a learned part.
pub(crate) struct Analytic {
    rung: &'static Rung,
    camera: Camera,
    frame: Screened,
    inspection: Inspection,
    /// The frame in bases that leave room for noise alone, where the search itself leaves none.
    compressed: Option<([Basis; 2], Reading)>,
    /// For frames that residual peaks do not explain at once, where spots mostly stand apart; in the compressed bases where there
    /// are any.
    pencil: Option<Search>,
    budget: Option<Duration>,
    search: Search,
    reading: Reading,
    weighing: Weighing,
    prior: Option<Prior>,
}

impl Analytic {
    pub fn new(rung: &'static Rung, camera: &Camera, budget: Option<Duration>, known: Option<&KnownPower>) -> Self {
        let (bases, compressed) = bases(camera);
        let pencil = rung
            .is_ordering()
            .then(|| Search::for_a_look(compressed.as_ref().unwrap_or(&bases).clone()));
        let search = Search::new(bases);
        let compressed = compressed.map(|bases| (bases, Reading::default()));
        Self {
            rung,
            camera: camera.clone(),
            frame: Screened::default(),
            inspection: Inspection::default(),
            compressed,
            pencil: pencil.flatten(),
            budget,
            search,
            reading: Reading::default(),
            weighing: Weighing::new(camera),
            prior: known
                .filter(|_| rung.method == Method::MaximumPosterior)
                .map(|k| Prior::new(k, camera)),
        }
    }

    /// Loads the frame into the search's bases; returns the noise in units of the configured.
    fn inspect(&mut self) -> f64 {
        let Self { search, reading, .. } = self;
        let (bx, by) = (&search.fitter.bx, &search.fitter.by);
        if !self.rung.is_ordering() {
            reading.load(&self.frame, bx, by);
            return 1.0;
        }
        match &mut self.compressed {
            None => {
                reading.load(&self.frame, bx, by);
                self.inspection.run(&mut self.frame, reading, bx, by)
            }
            Some(([cx, cy], compressed)) => {
                compressed.load(&self.frame, cx, cy);
                let scale = self.inspection.run(&mut self.frame, compressed, cx, cy);
                reading.load(&self.frame, bx, by);
                (reading.growth, reading.mean_variance, reading.lit_variance) =
                    (compressed.growth, compressed.mean_variance, compressed.lit_variance);
                scale
            }
        }
    }

    /// What the pencil's seeds lead to, where that soon explains the frame and nothing unusual is about.
    fn pencil_look(&mut self) -> Option<Model> {
        let reading = self.compressed.as_ref().map_or(&self.reading, |(_, r)| r);
        let search = self
            .pencil
            .as_mut()
            .filter(|s| reading.growth.is_flat() && !s.is_torn(reading))?;
        let limit = search.fitter.allow(SHORT);
        let look = search.first_look(reading, &self.frame);
        if !reading.is_explained(&look) {
            return None;
        }
        search.fitter.lift(limit);
        let model = search.maximum_likelihood(reading, &self.frame, look);
        reading.is_explained(&model).then_some(model)
    }

    /// Maximum likelihood from the first `look` on, without pixels that are lit alone. Where nothing but noise lies outside the
    /// basis, these are most likely a misfit, and taken out only where that explains the frame at once or nothing else does.
    fn search_on(&mut self, look: Model) -> Model {
        let is_clean = self.inspection.is_clean;
        let kept = is_clean.then(|| (self.frame.clone(), self.reading.clone()));
        let limit = self.search.fitter.allow(if is_clean { SHORT } else { f64::INFINITY });
        let rest = self.without_lone_pixels(look.clone());
        self.search.fitter.lift(limit);
        let Some((frame, reading)) = kept.filter(|_| !self.reading.is_explained(&rest)) else {
            return self.search.maximum_likelihood(&self.reading, &self.frame, rest);
        };
        let frame = std::mem::replace(&mut self.frame, frame);
        let reading = std::mem::replace(&mut self.reading, reading);
        let has_lone = reading.bad.len() > self.reading.bad.len();
        let limit = self.search.fitter.allow(if has_lone { TRIAL } else { f64::INFINITY });
        let model = self.search.maximum_likelihood(&self.reading, &self.frame, look);
        let is_done = !self.search.is_exhausted() && self.reading.is_explained(&model);
        self.search.fitter.lift(limit);
        if !has_lone || is_done {
            return model;
        }
        (self.frame, self.reading) = (frame, reading);
        self.search.maximum_likelihood(&self.reading, &self.frame, rest)
    }

    /// `look`, taken anew after taking out pixels that are lit alone.
    fn without_lone_pixels(&mut self, mut look: Model) -> Model {
        let Self { search, reading, .. } = self;
        for _ in 0..LOOKS {
            if reading.is_explained(&look) {
                break;
            }
            let expected = search.fitter.expectation(reading, &mut look);
            let (bx, by) = (&search.fitter.bx, &search.fitter.by);
            if !self.inspection.reject_lone(&mut self.frame, reading, expected, bx, by) {
                break;
            }
            look = search.first_look(reading, &self.frame);
        }
        look
    }
}

impl Estimator for Analytic {
    fn name(&self) -> &'static str {
        self.rung.name
    }

    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        let deadline = self.budget.map(|b| Instant::now() + b);
        self.frame.load(frame, &self.camera)?;
        let scale = self.inspect();
        self.search.restart(deadline);
        self.weighing.search.restart(deadline);
        if let Some(pencil) = &mut self.pencil {
            pencil.restart(deadline);
        }
        let mut is_by_pencil = false;
        let is_ml = self.rung.is_ordering();
        let mut model = match self.rung.method {
            Method::Peak { is_subpixel, steps } => {
                let mut model = self.search.peaks(&self.reading, is_subpixel);
                self.search.fitter.fit(&self.reading, &mut model, steps);
                model
            }
            Method::Greedy => {
                let dark = Model::empty(Nuisances::default());
                let mut model = self.search.greedy(&self.reading, &self.frame, dark);
                self.search.shrink(&self.reading, &mut model);
                model
            }
            Method::Pencil { steps } => {
                let plain = Nuisances::default();
                self.search.start(&self.reading, &self.frame, plain, steps)
            }
            Method::MaximumLikelihood | Method::MaximumPosterior => {
                let look = self.search.first_look(&self.reading, &self.frame);
                let is_explained = self.reading.is_explained(&look);
                let by_pencil = if is_explained { None } else { self.pencil_look() };
                is_by_pencil = by_pencil.is_some();
                by_pencil.unwrap_or_else(|| self.search_on(look))
            }
        };
        let (search, reading) = match &mut self.pencil {
            Some(pencil) if is_by_pencil => (pencil, self.compressed.as_ref().map_or(&self.reading, |(_, r)| r)),
            _ => (&mut self.search, &self.reading),
        };
        let known = search
            .suspected
            .or((!reading.growth.is_flat()).then_some(reading.growth));
        let is_weighted = is_ml
            && (known.is_some() || !reading.is_explained(&model))
            && self.weighing.run(&self.frame, known, &mut model);
        let (search, reading) = if is_weighted {
            (&mut self.weighing.search, &self.weighing.reading)
        } else {
            (search, reading)
        };
        let noise_j = scale * self.camera.noise_std_j;
        let mut centres = None;
        if let Some(mut prior) = self.prior.take() {
            prior.noise_j = noise_j;
            prior.temper = reading.misfit(&model);
            search.prior = Some(prior);
            search.maximum_posterior(reading, &mut model);
            self.prior = search.prior.take();
            centres = search.centres(reading, &mut model);
        }
        let is_exhausted = search.is_exhausted();
        let mut estimate = localise::locate(
            search,
            reading,
            &mut model,
            &self.frame,
            &self.camera,
            noise_j,
            centres.as_deref(),
        );
        estimate.rung = self.rung.name;
        estimate.is_cut_short = is_exhausted;
        let by_pencil = self.pencil.as_ref().map_or(0, |pencil| pencil.fitter.steps);
        estimate.steps = by_pencil + self.search.fitter.steps + self.weighing.search.fitter.steps;
        if is_exhausted {
            for emitter in &mut estimate.emitters {
                emitter.flags |= Flags::OUT_OF_TIME;
            }
        }
        Ok(estimate)
    }
}

impl Search {
    fn peaks(&mut self, reading: &Reading, is_subpixel: bool) -> Model {
        let mut model = Model::empty(Nuisances::default());
        let peaks = self
            .heatmap
            .peaks(&reading.z, reading.mx, reading.my, self.price.sqrt(), 1.0);
        let spots = peaks
            .iter()
            .map(|p| Spot::new(if is_subpixel { p.u } else { p.grid }, p.a));
        model.spots.extend(spots);
        model
    }
}
