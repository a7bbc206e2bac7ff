//! The search for the number of emitters: hypotheses are fitted jointly and held against each other.

use std::time::Instant;

use crate::estimate::detect::matched_filter::Heatmap;
use crate::estimate::detect::matrix_pencil::{Pencil, Sampler};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::nuisance_selection::{WIDE, is_doubled};
use crate::estimate::model_order::power_prior::Prior;
use crate::estimate::model_order::proposals::Certainty;
use crate::estimate::preprocess::noise_variance::Growth;
use crate::estimate::preprocess::screening::Screened;

/// Steps that a candidate may take before it is judged.
pub(crate) const TRIAL_STEPS: usize = 30;
/// So many further emitters that explain a frame are not asked for another explanation.
const FEW: usize = 2;
/// Steps that the pencil's seeds are polished by.
const POLISH: usize = 100;
/// Rounds of moves, and of those before another explanation than more emitters is tried.
pub(crate) const ROUNDS: usize = 8;
pub(crate) const EARLY_ROUNDS: usize = 3;
/// A misfit of this many standard deviations is worth another start.
const FAR: f64 = 5.0;
/// Emitters of a candidate may be this much cheaper, together, than those of the present hypothesis are on average.
const CHEAPER: f64 = 30.0;
/// More overlapping emitters than these are first taken for something else.
const BLOB: usize = 10;
/// Where more than this share of the pixels is unusable, the pencil would see what was filled in, and turned spots cost too much.
const TORN: f64 = 0.03;
/// Least drop of the deviance that a nuisance parameter must bring.
pub(crate) const NUISANCE_PRICE: f64 = 5.0;

/// The search with its settings that follow from the camera.
pub(crate) struct Search {
    pub fitter: Fitter,
    pub heatmap: Heatmap,
    /// Where spots are wide enough against the sensor for the pencil.
    pub(crate) sampler: Option<Sampler>,
    /// Least drop of the deviance that an emitter must bring.
    pub price: f64,
    /// What the noise of the frame's light multiplies prices by.
    pub factor: f64,
    /// How the noise seems to grow, where that explains a frame better than more emitters do.
    pub suspected: Option<Growth>,
    /// What is known of powers, where that is to be weighed in.
    pub prior: Option<Prior>,
    pub(crate) residual: Vec<f64>,
    pub(crate) certainty: Certainty,
}

impl Search {
    pub fn new([bx, by]: [Basis; 2]) -> Self {
        let sampler = Sampler::new(&bx, &by);
        Self::with(sampler, bx, by)
    }

    /// For a first look by the pencil where [`Search::new`] goes by residual peaks.
    pub fn for_a_look([bx, by]: [Basis; 2]) -> Option<Self> {
        let sampler = Sampler::for_a_look(&bx, &by)?;
        Some(Self::with(Some(sampler), bx, by))
    }

    fn with(sampler: Option<Sampler>, bx: Basis, by: Basis) -> Self {
        let fitter = Fitter::new(bx, by);
        let heatmap = Heatmap::new(&fitter.bx, &fitter.by);
        let area = |b: &Basis| b.edges[b.n] - b.edges[0];
        // The matched filter has about area/σ² independent positions; the price keeps the chance that any of
        // them exceeds it in an empty frame below 1e-3.
        let price = (10.0 + 2.0 * (area(&fitter.bx) * area(&fitter.by)).ln()).max(14.0);
        Self {
            fitter,
            heatmap,
            sampler,
            price,
            factor: 1.0,
            suspected: None,
            prior: None,
            residual: Vec::new(),
            certainty: Certainty::default(),
        }
    }

    /// Forgets the work done for the last frame.
    pub fn restart(&mut self, deadline: Option<Instant>) {
        self.fitter.restart(deadline);
        self.factor = 1.0;
        self.suspected = None;
        self.certainty = Certainty::default();
    }

    /// Whether the frame has had its share of work, or of time where a budget is set.
    pub fn is_exhausted(&self) -> bool {
        self.fitter.is_exhausted()
    }

    /// Deviance that `next` must get below to score better than `best`.
    pub(crate) fn bar(&self, best: &Model, next: &Model) -> f64 {
        let penalty = match &self.prior {
            None => self.penalty(next),
            // What emitters cost is known only once they are fitted: one more, of a known power, may cost less than none.
            Some(_) if best.spots.is_empty() => return f64::INFINITY,
            Some(_) => best.occam * (next.spots.len() as f64 / best.spots.len() as f64).min(1.0) - CHEAPER,
        };
        self.score(best) - penalty
    }

    /// What is held against each other: −2 ln likelihood plus the price of the emitters and nuisances; with powers
    /// weighed in, −2 ln of the posterior probability.
    pub fn score(&self, model: &Model) -> f64 {
        model.deviance + model.pull() + self.penalty(model)
    }

    fn penalty(&self, model: &Model) -> f64 {
        if self.prior.is_some() {
            return self.factor * model.occam;
        }
        let nuisances = NUISANCE_PRICE * model.nuisances.count() as f64;
        // A pair makes a turned ellipse of one spot, and is likelier than a lens that makes one of all.
        let priced = model.spots.len() + usize::from(model.nuisances.width == Width::Turned);
        self.factor * (self.price * priced as f64 + nuisances)
    }

    /// Maximum likelihood with the number of emitters unknown. Nuisances are fitted only where the frame cannot be
    /// explained without, and then within every hypothesis.
    pub fn maximum_likelihood(&mut self, reading: &Reading, frame: &Screened, look: Model) -> Model {
        self.factor = reading.lit_variance;
        let plain = look.nuisances;
        let first = look.clone();
        let mut model = if self.sampler.is_some() {
            look
        } else {
            self.greedy(reading, frame, look)
        };
        if self.suspected.is_some() {
            return model;
        }
        let mut is_settled = reading.is_explained(&model);
        if is_settled {
            self.refine(reading, &mut model, ROUNDS);
        } else {
            self.start_anew(reading, &mut model);
        }
        let is_far = reading.misfit(&model) > 1.0 + FAR * (2.0 / reading.numbers).sqrt();
        if is_far || model.nuisances != plain || self.is_odd(&model) && self.would_do_otherwise(reading, &model) {
            self.explain_otherwise(reading, frame, &mut model);
            is_settled = false;
        }
        // What a turned lens makes of one emitter takes several.
        let may_be_turned = match self.sampler {
            None => is_doubled(&model),
            Some(_) => !is_settled && self.is_odd(&model) && 3 * model.spots.len() > 4 * first.spots.len(),
        };
        if may_be_turned || !is_settled && !reading.is_explained(&model) {
            self.turn(reading, frame, first, &mut model);
            is_settled = false;
        }
        if !is_settled {
            self.fitter.reserve(0.3);
            self.refine(reading, &mut model, ROUNDS);
        }
        self.simplify(reading, &mut model);
        if !reading.is_explained(&model) {
            self.lay_ghosts(reading, frame, &mut model);
        }
        self.finish(reading, &mut model);
        model
    }

    /// Another way to the frame from where a first start ended: nuisances free it from a false minimum and are taken out again,
    /// then moves. What needs more emitters than a few beyond the first start's is not a matter of moves. Where none of that
    /// explains the frame and the nuisances alone did, they stay.
    fn start_anew(&mut self, reading: &Reading, model: &mut Model) {
        let first = model.clone();
        let mut wide = None;
        if self.sampler.is_some() {
            let mut free = first.clone();
            free.nuisances = WIDE;
            self.fitter.fit(reading, &mut free, TRIAL_STEPS);
            wide = Some(free.clone()).filter(|w| reading.is_explained(w));
            free.confine(first.nuisances);
            self.fitter.fit(reading, &mut free, TRIAL_STEPS);
            if self.score(&free) < self.score(model) {
                *model = free;
            }
        }
        if !reading.is_explained(model) && first.spots.len() <= BLOB {
            self.refine(reading, model, EARLY_ROUNDS);
        }
        if model.spots.len() > first.spots.len() + 1 {
            *model = first;
        }
        if let Some(mut wide) = wide.filter(|_| !reading.is_explained(model)) {
            self.refine(reading, &mut wide, EARLY_ROUNDS);
            if !self.is_odd(&wide) && self.score(&wide) < self.score(model) {
                *model = wide;
            }
        }
    }

    /// The pencil's emitters, or those that stand out at once with a background where the frame looks lit: enough to tell what
    /// in the residual cannot be light.
    pub fn first_look(&mut self, reading: &Reading, frame: &Screened) -> Model {
        self.factor = reading.lit_variance;
        if self.sampler.is_some() {
            return self.start(reading, frame, Nuisances::default(), POLISH);
        }
        let mut model = Model::empty(Nuisances {
            background: self.looks_lit(frame),
            width: Width::Known,
        });
        let peaks = self.residual_peaks(reading, &mut model);
        let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
        let spots = peaks
            .iter()
            .take_while(|p| p.significance >= least)
            .take(reading.most_spots());
        model.spots = spots.map(|p| Spot::new(p.u, p.a)).collect();
        self.fitter.fit(reading, &mut model, TRIAL_STEPS);
        model
    }

    /// Adds peaks of the residual to `model` until none is significant, refitting all emitters each time.
    pub fn greedy(&mut self, reading: &Reading, frame: &Screened, mut model: Model) -> Model {
        while model.spots.len() < reading.most_spots() && (model.spots.is_empty() || !reading.is_explained(&model)) {
            let room = reading.most_spots() - model.spots.len();
            let mut next = model.clone();
            let peaks = self.residual_peaks(reading, &mut model);
            let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
            let strong = peaks.iter().take_while(|p| p.significance >= least).take(room);
            next.spots.extend(strong.map(|p| Spot::new(p.u, p.a)));
            if next.spots.len() == model.spots.len() {
                break;
            }
            self.fitter.fit(reading, &mut next, TRIAL_STEPS);
            // What looks like more emitters may be a background or another width: the better explanation stands.
            if !reading.is_explained(&next) || next.spots.len() > model.spots.len() + FEW {
                let wider = self.widened(reading, &model, &next);
                if let Some(wider) = wider.filter(|w| self.score(w) < self.score(&next)) {
                    next = wider;
                }
            }
            if !reading.is_explained(&next) {
                self.suspected = self.suspect(reading, frame, &mut model, &next);
            }
            if self.suspected.is_some() || self.score(&next) > self.score(&model) {
                break;
            }
            model = next;
            if self.is_exhausted() {
                break;
            }
        }
        model
    }

    pub(crate) fn is_torn(&self, reading: &Reading) -> bool {
        reading.bad.len() as f64 > TORN * (self.fitter.bx.n * self.fitter.by.n) as f64
    }

    /// Seeds by the pencil for rising N until the frame is explained: as configured first, then with a background and
    /// another width, both of which have singular values of their own.
    fn pencil(&mut self, reading: &Reading, nuisances: Nuisances, polish: usize) -> Option<Model> {
        if self.is_torn(reading) {
            return None;
        }
        let pencil = self
            .sampler
            .as_mut()?
            .analyse(reading, &self.fitter.bx, &self.fitter.by)?;
        let sure = pencil.strength.iter().take_while(|&&s| s > 4.0).count();
        let likely = pencil.strength.iter().take_while(|&&s| s > 0.5).count();
        let last = (likely + 2).min(pencil.most()).min(reading.most_spots());
        let mut best = Model::empty(nuisances);
        self.fitter.fit(reading, &mut best, TRIAL_STEPS);
        // A background and another width have singular values of their own.
        let is_plain = nuisances == Nuisances::default();
        let (first, beyond) = if is_plain { (sure, 2) } else { (sure / 3, 3) };
        self.climb(
            reading,
            &pencil,
            &mut best,
            nuisances,
            first.max(1)..=last.min(sure.max(3) + beyond),
            polish,
        );
        Some(best)
    }

    /// Fits the pencil's seeds for each count until `best`, which takes what scores better, explains the frame.
    fn climb(
        &mut self,
        reading: &Reading,
        pencil: &Pencil,
        best: &mut Model,
        nuisances: Nuisances,
        counts: std::ops::RangeInclusive<usize>,
        polish: usize,
    ) {
        let patience = if nuisances == Nuisances::default() { 1 } else { 3 };
        let mut worse = 0;
        for count in counts {
            if reading.is_explained(best) || worse == patience || !best.spots.is_empty() && self.is_exhausted() {
                break;
            }
            let Some(seeds) = pencil.seeds(count) else { break };
            let mut model = Model::empty(nuisances);
            model.spots.extend(seeds.into_iter().map(|u| Spot::new(u, 0.0)));
            self.fitter.fit(reading, &mut model, polish);
            if self.score(&model) < self.score(best) {
                *best = model;
                worse = 0;
            } else if best.nuisances == nuisances {
                worse += 1;
            }
        }
    }

    /// Seeds by the pencil where spots overlap, by residual peaks elsewhere.
    pub fn start(&mut self, reading: &Reading, frame: &Screened, nuisances: Nuisances, polish: usize) -> Model {
        self.pencil(reading, nuisances, polish).unwrap_or_else(|| {
            let mut dark = Model::empty(nuisances);
            self.fitter.fit(reading, &mut dark, TRIAL_STEPS);
            self.greedy(reading, frame, dark)
        })
    }

    /// Fits `model` under new weights: nuisances where the frame cannot be explained without, then moves.
    pub fn settle(&mut self, reading: &Reading, model: &mut Model, rounds: usize) {
        self.fitter.fit(reading, model, TRIAL_STEPS);
        if !reading.is_explained(model)
            && let Some(wider) = self.widened(reading, model, model)
        {
            *model = wider;
        }
        self.refine(reading, model, rounds);
        self.simplify(reading, model);
    }

    /// How the noise grows where that explains the frame better than `rival` does; only in the pixel bases.
    fn suspect(&mut self, reading: &Reading, frame: &Screened, model: &mut Model, rival: &Model) -> Option<Growth> {
        let is_even = self.fitter.bx.is_pixels && self.fitter.by.is_pixels && reading.weights.is_empty();
        if !is_even || rival.deviance < 0.5 * model.deviance {
            return None;
        }
        let residual = self.fitter.residual_of(reading, model).to_vec();
        let signal = self.fitter.expectation(reading, model);
        let growth = Growth::fit(
            frame,
            [reading.rank[0], reading.mx],
            &residual,
            &signal,
            model.spots.len(),
        );
        let nx = self.fitter.bx.n;
        let cost: f64 = (0..frame.is_bad.len())
            .filter(|&k| !frame.is_bad[k])
            .map(|k| k / nx * reading.mx + k % nx)
            .map(|k| growth.at(signal[k]).ln() + residual[k].powi(2) / growth.at(signal[k]))
            .sum();
        let score = self.score(model) - model.deviance + cost + Growth::PRICE;
        (score < self.score(rival)).then_some(growth)
    }
}
