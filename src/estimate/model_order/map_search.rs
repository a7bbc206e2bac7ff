//! Maximum a posteriori: the number of emitters and their places by the evidence of the frame and of known powers.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Spot};
use crate::estimate::model_order::power_prior::Prior;
use crate::estimate::model_order::proposals::{merged, pairs};
use crate::estimate::model_order::search::{NUISANCE_PRICE, Search, TRIAL_STEPS};

/// Rounds of moves.
const ROUNDS: usize = 6;
/// A spot is taken for a user's, to begin with, where its energy speaks against that no more than this.
pub(crate) const LENIENCY: f64 = 60.0;
/// A spot of this many times a known power may be two.
const TWOFOLD: f64 = 1.4;
/// Parts of a divided spot stand this far apart, σ, at least and at most.
const SPACING: [f64; 2] = [0.1, 0.8];
const MOST_PARTS: usize = 4;
/// All the light may be this much more or less, in emitters, than that of as many users as there are spots.
const SURPLUS: f64 = 0.4;
/// Spots and pairs looked at in a round, and how near the two of a pair stand, σ.
const BRIGHTEST: usize = 6;
const PAIRS: usize = 6;
const NEIGHBOURS: f64 = 4.0;

impl Search {
    /// From a model that explains the frame to the most probable one. `self.prior` must be set; does nothing without.
    pub fn maximum_posterior(&mut self, reading: &Reading, model: &mut Model) {
        if self.prior.is_none() {
            return;
        }
        self.weigh_up(reading, model, f64::INFINITY, 0.0);
        let known = model.clone();
        self.attempt(reading, model, known);
        for _ in 0..ROUNDS {
            let before = self.score(model);
            self.explore(reading, model);
            self.divide(reading, model);
            self.balance(reading, model);
            self.unite(reading, model);
            self.shrink(reading, model);
            self.grow(reading, model);
            if before - self.score(model) < 0.1 || self.is_exhausted() {
                break;
            }
        }
        self.finish(reading, model);
    }

    /// Fits `model` under the prior, every spot labelled with `leniency` first and by its energy after, and sets what
    /// its number of emitters costs.
    pub(crate) fn weigh_up(&mut self, reading: &Reading, model: &mut Model, bar: f64, leniency: f64) {
        let Some(prior) = self.prior.take() else { return };
        prior.label(model, leniency);
        self.fitter.fit_below(reading, model, TRIAL_STEPS, bar);
        if prior.label(model, 0.0) {
            self.fitter.fit(reading, model, TRIAL_STEPS);
        }
        model.occam = self.occam(reading, model, &prior);
        self.prior = Some(prior);
    }

    /// −2 ln of what integrating over positions and energies leaves of the likelihood's peak (Laplace; MacKay, 2003,
    /// eq. 28.10) times the prior: even over the sensor in position, and blind to the emitters' order.
    fn occam(&mut self, reading: &Reading, model: &mut Model, prior: &Prior) -> f64 {
        let n = model.spots.len();
        let (bx, by) = (&self.fitter.bx, &self.fitter.by);
        let side = |b: &crate::estimate::model::svd_basis::Basis| b.highest() - b.lowest();
        let area = side(bx) * side(by);
        // A position is never known better by the Hessian than a spot and a pixel allow it to be unknown.
        let least = |b: &crate::estimate::model::svd_basis::Basis| 1.0 / (0.25 + b.pitch() * b.pitch() / 12.0);
        let floors = |s: &Spot| [least(bx), least(by), prior.least_precision(s)];
        let floor: Vec<_> = model.spots.iter().map(floors).collect();
        let p = model.parameters();
        self.fitter.information(reading, model);
        let log_det = self.fitter.log_det(p, &floor).unwrap_or(f64::INFINITY);
        let orders: f64 = (2..=n).map(|k| 2.0 * (k as f64).ln()).sum();
        let volume = n as f64 * (2.0 * area.ln() - 3.0 * std::f64::consts::TAU.ln());
        let nuisances = NUISANCE_PRICE * model.nuisances.count() as f64;
        prior.temper * (log_det + volume - orders + nuisances) + prior.total_cost(model)
    }

    /// Tries `next` with every doubt about a spot's label in favour of a user.
    pub(crate) fn attempt(&mut self, reading: &Reading, model: &mut Model, mut next: Model) -> bool {
        if self.is_exhausted() {
            return false;
        }
        let bar = self.bar(model, &next);
        self.weigh_up(reading, &mut next, bar, LENIENCY);
        let is_better = self.score(&next) < self.score(model) - 1e-6;
        if is_better {
            *model = next;
        }
        is_better
    }

    /// Emitters by which the light is more than that of as many users as there are spots.
    fn surplus(&self, model: &Model) -> f64 {
        let Some(prior) = &self.prior else { return 0.0 };
        model.spots.iter().map(|s| prior.multiple(s) - 1.0).sum()
    }

    /// Puts two or more emitters where one shows the light of several, and where several show that of one more.
    fn divide(&mut self, reading: &Reading, model: &mut Model) {
        let Some(prior) = &self.prior else { return };
        let mut bright: Vec<(f64, usize)> = model.spots.iter().map(|s| prior.multiple(s)).zip(0..).collect();
        bright.sort_by(|p, q| q.0.total_cmp(&p.0));
        let least = if self.surplus(model) > SURPLUS { 0.0 } else { TWOFOLD };
        bright.retain(|b| b.0 > least);
        bright.truncate(BRIGHTEST);
        if bright.is_empty() {
            return;
        }
        let directions = self.splits(reading, model);
        for (multiple, index) in bright {
            let spot = model.spots[index];
            let split = directions.iter().find(|d| d.index == index);
            let (along, spread) = split.map_or(([1.0, 0.0], 0.0), |d| (d.direction, d.distance * d.distance));
            let parts = (multiple.round() as usize).max(2);
            let across = [-along[1], along[0]];
            for (direction, spread) in [(along, spread), (along, 1.0), (across, 1.0)] {
                let mut next = model.clone();
                next.spots.remove(index);
                next.spots.extend(divided(spot, parts, direction, spread));
                if self.attempt(reading, model, next) {
                    return;
                }
            }
        }
    }

    /// Shares the light of two spots evenly, among as many as it is of, where one of them shows no known power.
    fn balance(&mut self, reading: &Reading, model: &mut Model) {
        let Some(prior) = &self.prior else { return };
        let is_odd = |p: &&(f64, usize, usize)| model.spots[p.1].power.is_none() || model.spots[p.2].power.is_none();
        let near = pairs(model, NEIGHBOURS);
        let odd: Vec<(usize, usize, f64)> = near
            .iter()
            .filter(is_odd)
            .take(PAIRS)
            .map(|&(_, i, j)| (i, j, prior.multiple(&merged(model, &[(i, j)]).spots[j])))
            .collect();
        for (i, j, multiple) in odd {
            let [p, q] = [i, j].map(|k| model.spots[k].u);
            let d = [0, 1].map(|k| p[k] - q[k]);
            let length = d[0].hypot(d[1]).max(1e-6);
            let [a, b] = [i, j].map(|k| model.spots[k].a);
            let spread = a * b * (length / (a + b)).powi(2);
            let mut united = merged(model, &[(i, j)]);
            let spot = united.spots.remove(j);
            let parts = (multiple.round() as usize).max(1);
            for spread in [spread, 1.0] {
                let mut next = united.clone();
                next.spots.extend(divided(spot, parts, d.map(|v| v / length), spread));
                if self.attempt(reading, model, next) {
                    return;
                }
            }
        }
    }

    /// Makes one emitter of two where there are more spots than the light is of.
    fn unite(&mut self, reading: &Reading, model: &mut Model) {
        if self.surplus(model) > -SURPLUS {
            return;
        }
        for (_, i, j) in pairs(model, NEIGHBOURS).into_iter().take(PAIRS) {
            let next = merged(model, &[(i, j)]);
            if self.attempt(reading, model, next) {
                return;
            }
        }
    }
}

/// A spot's light in equal parts on a line, with that second moment, σ², as far as parts may be near and apart.
fn divided(spot: Spot, parts: usize, direction: [f64; 2], spread: f64) -> impl Iterator<Item = Spot> {
    let parts = parts.min(MOST_PARTS);
    let spacing = (12.0 * spread / (parts * parts - 1).max(1) as f64)
        .sqrt()
        .clamp(SPACING[0], SPACING[1]);
    (0..parts).map(move |k| {
        let shift = spacing * (k as f64 - 0.5 * (parts - 1) as f64);
        let u = [0, 1].map(|axis| spot.u[axis] + shift * direction[axis]);
        Spot::new(u, spot.a / parts as f64)
    })
}
