//! What a frame may show instead of more emitters: a background, another width, noise that grows with the light.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Width};
use crate::estimate::model_order::proposals::{merged, pairs};
use crate::estimate::model_order::search::{EARLY_ROUNDS, ROUNDS, Search, TRIAL_STEPS};
use crate::estimate::preprocess::screening::Screened;

/// Overlapping spots whose energies differ by more than this factor may be none.
const UNLIKE: f64 = 3.0;
/// Emitters of this many prices' significance are beyond doubt, whatever the misfit around them.
const GHOST: f64 = 100.0;
/// Misfit counts as around an emitter within this many σ.
const AROUND: f64 = 2.0;
/// What may stand instead of emitters.
pub(crate) const WIDE: Nuisances = Nuisances {
    background: true,
    width: Width::Common,
};
const TURNED: Nuisances = Nuisances {
    background: true,
    width: Width::Turned,
};
/// Shares of a frame's work that turned spots may take before and after they have brought what upright ones leave down to a share.
const TRIAL: f64 = 0.2;
const TURN: f64 = 0.7;
const MUCH: f64 = 0.02;
/// Spots nearer than this, σ, may be a double that the lens makes.
const DOUBLE: f64 = 1.5;
/// Emitters of less than this many prices' significance may be a background's or a width's.
const DOUBT: f64 = 4.0;
/// Steps that the pencil's seeds are polished by where more is fitted beside.
const LONG_POLISH: usize = 150;

impl Search {
    /// Takes another explanation of the frame than more emitters: a background, another width, or both, where one scores
    /// better than `model`.
    pub(crate) fn explain_otherwise(&mut self, reading: &Reading, frame: &Screened, model: &mut Model) {
        if model.nuisances == WIDE && reading.is_explained(model) && !self.is_odd(model) {
            return;
        }
        let lit = Nuisances {
            background: true,
            width: Width::Known,
        };
        // A background has singular values of its own, which the pencil would take for emitters.
        let grown = if self.sampler.is_some() {
            let mut grown = Model::empty(lit);
            self.fitter.fit(reading, &mut grown, TRIAL_STEPS);
            self.refine(reading, &mut grown, ROUNDS);
            grown
        } else {
            self.start(reading, frame, lit, LONG_POLISH)
        };
        self.take_better(model, grown);
        if reading.is_explained(model) && !self.is_odd(model) {
            let mut next = model.clone();
            next.nuisances = WIDE;
            self.fitter.fit(reading, &mut next, TRIAL_STEPS);
            self.refine(reading, &mut next, EARLY_ROUNDS);
            self.take_better(model, next);
        }
        if !reading.is_explained(model) || self.is_odd(model) {
            let next = self.start(reading, frame, WIDE, LONG_POLISH);
            self.take_better(model, next);
        }
        if !reading.is_explained(model)
            && let Some(wider) = self.widened(reading, model, model)
        {
            *model = wider;
        }
    }

    /// Whether a background and another width can stand for emitters of a model that explains the frame.
    pub(crate) fn would_do_otherwise(&mut self, reading: &Reading, model: &Model) -> bool {
        let mut next = model.clone();
        next.nuisances = WIDE;
        self.fitter.fit(reading, &mut next, TRIAL_STEPS);
        let significance = self.significance(reading, &mut next);
        if significance.iter().filter(|s| **s < DOUBT * self.price).count() < 2 {
            return false;
        }
        self.shrink(reading, &mut next);
        self.score(&next) < self.score(model)
    }

    fn take_better(&self, model: &mut Model, next: Model) {
        if self.score(&next) < self.score(model) {
            *model = next;
        }
    }

    /// `model` with those further nuisances that explain the frame best, if any do, and better than `rival`.
    pub(crate) fn widened(&mut self, reading: &Reading, model: &Model, rival: &Model) -> Option<Model> {
        if model.spots.is_empty() {
            return None;
        }
        let mut best: Option<Model> = None;
        for width in [Width::Known, Width::Common, Width::PerAxis] {
            let nuisances = Nuisances {
                background: true,
                width,
            };
            if nuisances.count() <= model.nuisances.count() {
                continue;
            }
            let mut next = best.clone().unwrap_or_else(|| model.clone());
            next.nuisances = nuisances;
            let bar = self.bar(rival, &next);
            self.fitter.fit_below(reading, &mut next, TRIAL_STEPS, bar);
            if self.score(&next) < best.as_ref().map_or(self.score(model), |b| self.score(b)) {
                let is_explained = reading.is_explained(&next);
                best = Some(next);
                if is_explained {
                    break;
                }
            }
        }
        best
    }

    /// Takes turned spots where they explain the frame: from `model` with its doubles made one, or where spots melt from where the
    /// `first` look ended and from seeds of their own.
    pub(crate) fn turn(&mut self, reading: &Reading, frame: &Screened, first: Model, model: &mut Model) {
        if model.spots.is_empty() || self.is_torn(reading) {
            return;
        }
        let is_melted = self.sampler.is_some();
        let mut next = if is_melted {
            first
        } else {
            merged(model, &doubles(model))
        };
        next.nuisances = WIDE;
        self.fitter.fit(reading, &mut next, TRIAL_STEPS);
        if reading.is_explained(&next) {
            return self.take_better(model, next);
        }
        let left = next.deviance - reading.numbers;
        next.nuisances = TURNED;
        let limit = self.fitter.allow(TRIAL);
        self.fitter.fit(reading, &mut next, TRIAL_STEPS);
        self.fitter.lift(limit);
        if !reading.is_explained(&next) && next.deviance - reading.numbers > MUCH * left {
            return;
        }
        self.fitter.allow(TURN);
        self.fitter.fit(reading, &mut next, LONG_POLISH);
        if reading.is_explained(&next) {
            self.refine(reading, &mut next, EARLY_ROUNDS);
        }
        self.take_better(model, next);
        if is_melted && (!reading.is_explained(model) || self.is_odd(model)) {
            let next = self.start(reading, frame, TURNED, LONG_POLISH);
            self.take_better(model, next);
        }
        self.fitter.lift(limit);
    }

    /// Takes out nuisances that the frame can do without.
    pub(crate) fn simplify(&mut self, reading: &Reading, model: &mut Model) {
        let simpler = [
            Nuisances {
                background: model.nuisances.background,
                width: Width::Known,
            },
            Nuisances {
                background: false,
                width: model.nuisances.width,
            },
            Nuisances::default(),
        ];
        for nuisances in simpler {
            if nuisances.count() < model.nuisances.count() {
                let mut next = model.clone();
                next.confine(nuisances);
                self.consider(reading, model, next);
            }
        }
    }

    /// Whether overlapping spots are so unlike in energy that a background or another width may have been taken for some.
    pub(crate) fn is_odd(&self, model: &Model) -> bool {
        let energies = model.spots.iter().map(|s| s.a);
        let [least, most] = [
            energies.clone().fold(f64::INFINITY, f64::min),
            energies.fold(0.0, f64::max),
        ];
        self.sampler.is_some() && most > UNLIKE * least
    }

    /// Whether the frame's dark parts are clearly lighter or darker than the noise allows. Only for spots that leave parts
    /// dark; a fainter background shows in what the emitters leave.
    pub(crate) fn looks_lit(&self, frame: &Screened) -> bool {
        if self.sampler.is_some() {
            return false;
        }
        let (mut usable, mut low) = (0.0, 0.0);
        for (p, _) in frame.pixels.iter().zip(&frame.is_bad).filter(|(_, bad)| !**bad) {
            usable += 1.0;
            low += f64::from(u8::from(*p < -1.0));
        }
        // The share of standard normal noise below −1.
        let expected: f64 = 0.1587 * usable;
        low < 0.25 * expected - 5.0 || low > expected + 5.0 * expected.sqrt()
    }

    /// Drops emitters that the misfit around them explains as well: where gain scatter or a wrong spot leaves a residual
    /// that grows with the light, an emitter must stand out of that residual and not of the noise alone.
    pub(crate) fn lay_ghosts(&mut self, reading: &Reading, frame: &Screened, model: &mut Model) {
        let mut image = Vec::new();
        loop {
            let significance = self.significance(reading, model);
            let mut order: Vec<usize> = (0..model.spots.len()).collect();
            order.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
            let mut has_dropped = false;
            for index in order.into_iter().take_while(|&i| significance[i] < GHOST * self.price) {
                let spot = model.spots[index];
                let mut next = model.clone();
                next.spots.remove(index);
                self.fitter.fit(reading, &mut next, TRIAL_STEPS);
                let residual = self.fitter.residual_of(reading, &mut next).to_vec();
                let (bx, by) = (&self.fitter.bx, &self.fitter.by);
                reading.expand_matrix(&residual, bx, by, &mut image);
                let (mut sum, mut count) = (0.0, 0.0);
                for (k, r) in image.iter().enumerate().filter(|(k, _)| !frame.is_bad[*k]) {
                    let x = bx.edges[k % bx.n] + 0.5 * bx.pitch() - spot.u[0];
                    let y = by.edges[k / bx.n] + 0.5 * by.pitch() - spot.u[1];
                    if x * x + y * y < AROUND * AROUND {
                        sum += r * r;
                        count += 1.0;
                    }
                }
                let share = reading.numbers / image.len() as f64;
                let around = if count > 0.0 {
                    (sum / count / share).max(1.0)
                } else {
                    1.0
                };
                if next.deviance - model.deviance < self.price * around {
                    *model = next;
                    has_dropped = true;
                    break;
                }
            }
            if !has_dropped {
                return;
            }
        }
    }
}

/// Pairs of near spots, each spot in one at most.
fn doubles(model: &Model) -> Vec<(usize, usize)> {
    let mut chosen: Vec<(usize, usize)> = Vec::new();
    for (_, i, j) in pairs(model, DOUBLE) {
        if chosen
            .iter()
            .all(|&(a, b)| ![a, b].contains(&i) && ![a, b].contains(&j))
        {
            chosen.push((i, j));
        }
    }
    chosen
}

/// Whether so many emitters come in twos that the lens may make two of one.
pub(crate) fn is_doubled(model: &Model) -> bool {
    let doubles = doubles(model).len();
    doubles > 1 && 4 * doubles >= model.spots.len()
}
