//! The search for the number of emitters: hypotheses are fitted jointly and held against each other.

use std::time::Instant;

use super::basis::Basis;
use super::fit::Fitter;
use super::heatmap::Heatmap;
use super::model::{Model, Nuisances, Spot, Width};
use super::noise::Growth;
use super::pencil::{Pencil, Sampler};
use super::reading::Reading;
use super::screen::Screened;

/// Emitters a frame may hold at most.
const MOST: usize = 80;
/// Two greedy peaks of one round stand at least this far apart, σ.
const SEPARATION: f64 = 2.5;
/// Steps that a candidate may take before it is judged, and a chosen model before it is reported.
const TRIAL_STEPS: usize = 30;
const FINAL_STEPS: usize = 200;
/// Fewer steps than this are asked for by rungs that only polish seeds.
const MINIMAL_POLISH: usize = 10;
/// So many further emitters that explain a frame are not asked for another explanation.
const FEW: usize = 2;
/// Rounds of moves.
const ROUNDS: usize = 8;
/// Spots nearer than this, σ, may be one.
const MERGE: f64 = 2.5;
/// A split puts its halves this far to either side, σ.
const SPLIT: f64 = 0.4;
/// Emitters of this many prices' significance are beyond doubt, whatever the misfit around them.
const GHOST: f64 = 100.0;
/// Misfit counts as around an emitter within this many σ.
const AROUND: f64 = 2.0;
/// Least drop of the deviance that a nuisance parameter must bring.
const NUISANCE_PRICE: f64 = 5.0;

/// The search with its settings that follow from the camera.
pub(super) struct Search {
    pub fitter: Fitter,
    pub heatmap: Heatmap,
    /// Where spots are wide enough against the sensor for the pencil.
    sampler: Option<Sampler>,
    /// Least drop of the deviance that an emitter must bring.
    pub price: f64,
    /// What the noise of the frame's light multiplies prices by.
    pub factor: f64,
    /// How the noise seems to grow, where that explains a frame better than more emitters do.
    pub suspected: Option<Growth>,
    residual: Vec<f64>,
}

impl Search {
    pub fn new(bases: [Basis; 2]) -> Self {
        let [bx, by] = bases;
        let sampler = Sampler::new(&bx, &by);
        let fitter = Fitter::new(bx, by);
        let heatmap = Heatmap::new(&fitter.bx, &fitter.by);
        let area = |b: &Basis| b.edges[b.n] - b.edges[0];
        // The matched filter has about area/σ² independent positions; the price keeps the chance that any of
        // them exceeds it in an empty frame below 1e-3.
        let price = (6.0 + 2.0 * (area(&fitter.bx) * area(&fitter.by)).ln()).max(13.0);
        Self {
            fitter,
            heatmap,
            sampler,
            price,
            factor: 1.0,
            suspected: None,
            residual: Vec::new(),
        }
    }

    /// Forgets the work done for the last frame.
    pub fn restart(&mut self, deadline: Option<Instant>) {
        self.fitter.restart(deadline);
        self.factor = 1.0;
        self.suspected = None;
    }

    /// Whether the frame has had its share of work, or of time where a budget is set.
    pub fn is_exhausted(&self) -> bool {
        self.fitter.is_exhausted()
    }

    /// Deviance that `next` must get below to score better than `best`.
    fn bar(&self, best: &Model, next: &Model) -> f64 {
        self.score(best) - self.penalty(next)
    }

    /// What is held against each other: −2 ln likelihood plus the price of the emitters and nuisances.
    pub fn score(&self, model: &Model) -> f64 {
        model.deviance + self.penalty(model)
    }

    fn penalty(&self, model: &Model) -> f64 {
        let nuisances = NUISANCE_PRICE * model.nuisances.count() as f64;
        self.factor * (self.price * model.spots.len() as f64 + nuisances)
    }

    /// Maximum likelihood with the number of emitters unknown. Nuisances are fitted only where the frame cannot be
    /// explained without, and then within every hypothesis.
    pub fn maximum_likelihood(&mut self, reading: &Reading, frame: &Screened, look: Option<Model>) -> Model {
        self.factor = reading.lit_variance;
        let plain = look.as_ref().map_or(Nuisances::default(), |l| l.nuisances);
        let mut model = match look {
            Some(look) => self.greedy(reading, frame, look),
            None => self.start(reading, frame, plain, 60),
        };
        if self.suspected.is_some() {
            return model;
        }
        // A background has singular values of its own: what the first start explained with it may hold ghosts.
        if !reading.is_explained(&model) || model.nuisances != plain {
            for width in [Width::Known, Width::Common, Width::PerAxis] {
                let nuisances = Nuisances {
                    background: true,
                    width,
                };
                let is_settled = reading.is_explained(&model) && width != Width::Known;
                if is_settled || nuisances == plain || self.is_exhausted() {
                    continue;
                }
                let next = self.start(reading, frame, nuisances, 60);
                if self.score(&next) < self.score(&model) {
                    model = next;
                }
            }
        }
        self.fitter.reserve(0.3);
        self.refine(reading, &mut model, ROUNDS);
        self.simplify(reading, &mut model);
        if !reading.is_explained(&model) {
            self.lay_ghosts(reading, frame, &mut model);
        }
        self.finish(reading, &mut model);
        model
    }

    /// Drops emitters that the misfit around them explains as well: where gain scatter or a wrong spot leaves a residual
    /// that grows with the light, an emitter must stand out of that residual and not of the noise alone.
    fn lay_ghosts(&mut self, reading: &Reading, frame: &Screened, model: &mut Model) {
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

    /// `model` with those further nuisances that explain the frame best, if any do.
    fn widened(&mut self, reading: &Reading, model: &Model) -> Option<Model> {
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
            self.fitter.fit(reading, &mut next, TRIAL_STEPS);
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

    /// The emitters that stand out at once, with a background where the frame looks lit: enough to tell what in the
    /// residual cannot be light.
    pub fn first_look(&mut self, reading: &Reading, frame: &Screened) -> Option<Model> {
        if self.sampler.is_some() {
            return None;
        }
        let mut model = Model::empty(Nuisances {
            background: self.looks_lit(frame),
            width: Width::Known,
        });
        let peaks = self.residual_peaks(reading, &mut model);
        let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
        let spots = peaks.iter().take_while(|p| p.significance >= least).take(MOST);
        model.spots = spots.map(|p| Spot { u: p.u, a: p.a }).collect();
        self.fitter.fit(reading, &mut model, TRIAL_STEPS);
        Some(model)
    }

    /// Whether the frame's dark parts are clearly lighter or darker than the noise allows. Only for spots that leave parts
    /// dark; a fainter background shows in what the emitters leave.
    fn looks_lit(&self, frame: &Screened) -> bool {
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

    /// Takes out nuisances that the frame can do without.
    fn simplify(&mut self, reading: &Reading, model: &mut Model) {
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
                next.nuisances = nuisances;
                if nuisances.width == Width::Known {
                    next.width = [1.0; 2];
                }
                if !nuisances.background {
                    next.background = [0.0; 3];
                }
                self.consider(reading, model, next);
            }
        }
    }

    /// Adds peaks of the residual to `model` until none is significant, refitting all emitters each time.
    pub fn greedy(&mut self, reading: &Reading, frame: &Screened, mut model: Model) -> Model {
        while model.spots.len() < MOST && (model.spots.is_empty() || !reading.is_explained(&model)) {
            let room = MOST - model.spots.len();
            let mut next = model.clone();
            let peaks = self.residual_peaks(reading, &mut model);
            let least = peaks.first().map_or(0.0, |p| 0.1 * p.significance);
            let strong = peaks.iter().take_while(|p| p.significance >= least).take(room);
            next.spots.extend(strong.map(|p| Spot { u: p.u, a: p.a }));
            if next.spots.len() == model.spots.len() {
                break;
            }
            self.fitter.fit(reading, &mut next, TRIAL_STEPS);
            // What looks like more emitters may be a background or another width: the better explanation stands.
            if !reading.is_explained(&next) || next.spots.len() > model.spots.len() + FEW {
                let wider = self.widened(reading, &model);
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

    /// Seeds by the pencil for rising N until the frame is explained: as configured first, then with a background and
    /// another width, both of which have singular values of their own.
    fn pencil(&mut self, reading: &Reading, nuisances: Nuisances, polish: usize) -> Option<Model> {
        let pencil = self
            .sampler
            .as_mut()?
            .analyse(reading, &self.fitter.bx, &self.fitter.by)?;
        let sure = pencil.strength.iter().take_while(|&&s| s > 4.0).count();
        let likely = pencil.strength.iter().take_while(|&&s| s > 0.5).count();
        let last = (likely + 2).min(pencil.most()).min(MOST);
        let mut best = Model::empty(nuisances);
        self.fitter.fit(reading, &mut best, TRIAL_STEPS);
        self.climb(
            reading,
            &pencil,
            &mut best,
            nuisances,
            sure.max(1)..=last.min(sure + 3),
            polish,
        );
        if polish > MINIMAL_POLISH && !reading.is_explained(&best) && nuisances == Nuisances::default() {
            let wide = Nuisances {
                background: true,
                width: Width::Common,
            };
            let first = sure.saturating_sub(6).max(1);
            self.climb(reading, &pencil, &mut best, wide, first..=last, polish);
            if !reading.is_explained(&best) {
                self.climb(reading, &pencil, &mut best, nuisances, sure + 4..=last, polish);
            }
        }
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
        let mut worse = 0;
        for count in counts {
            if reading.is_explained(best) || worse == 3 || self.is_exhausted() {
                break;
            }
            let Some(seeds) = pencil.seeds(count) else { break };
            let mut model = Model::empty(nuisances);
            model.spots.extend(seeds.into_iter().map(|u| Spot { u, a: 0.0 }));
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
            && let Some(wider) = self.widened(reading, model)
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
        let growth = Growth::fit(frame, reading, &residual, &signal, model.spots.len());
        let nx = self.fitter.bx.n;
        let cost: f64 = (0..frame.is_bad.len())
            .filter(|&k| !frame.is_bad[k])
            .map(|k| k / nx * reading.mx + k % nx)
            .map(|k| growth.at(signal[k]).ln() + residual[k].powi(2) / growth.at(signal[k]))
            .sum();
        let score = self.score(model) - model.deviance + cost + Growth::PRICE;
        (score < self.score(rival)).then_some(growth)
    }

    /// The number of emitters of least score: moves from `model` until none helps, then a fit to convergence.
    pub fn refine(&mut self, reading: &Reading, model: &mut Model, rounds: usize) {
        for _ in 0..rounds {
            let before = self.score(model);
            if !reading.is_explained(model) {
                self.finish(reading, model);
            }
            self.grow(reading, model);
            self.shrink(reading, model);
            if before - self.score(model) < 0.1 || self.is_exhausted() {
                break;
            }
        }
        self.finish(reading, model);
    }

    fn finish(&mut self, reading: &Reading, model: &mut Model) {
        if !model.converged {
            self.fitter.fit(reading, model, FINAL_STEPS);
        }
    }

    /// Tries `next` and keeps it where it is better.
    fn consider(&mut self, reading: &Reading, model: &mut Model, mut next: Model) -> bool {
        if next.spots.len() > MOST || self.is_exhausted() {
            return false;
        }
        let bar = self.bar(model, &next);
        self.fitter.fit_below(reading, &mut next, TRIAL_STEPS, bar);
        let is_better = self.score(&next) < self.score(model) - 1e-6;
        if is_better {
            *model = next;
        }
        is_better
    }

    fn residual_peaks(&mut self, reading: &Reading, model: &mut Model) -> &[super::heatmap::Peak] {
        self.residual.clear();
        self.residual.extend_from_slice(self.fitter.residual_of(reading, model));
        self.fitter.clean(reading, &mut self.residual);
        let (mx, my) = (reading.mx, reading.my);
        // A peak's share that other spots have absorbed comes back in the joint fit: look a little lower.
        let threshold = 0.7 * (self.factor * self.price).sqrt();
        self.heatmap.peaks(&self.residual, mx, my, threshold, SEPARATION)
    }

    /// Adds, splits and relocates.
    fn grow(&mut self, reading: &Reading, model: &mut Model) {
        let peaks: Vec<_> = self.residual_peaks(reading, model).iter().take(2).copied().collect();
        for peak in &peaks {
            let mut next = model.clone();
            next.spots.push(Spot { u: peak.u, a: peak.a });
            if self.consider(reading, model, next) {
                break;
            }
        }
        if reading.is_explained(model) {
            return;
        }
        for (index, direction) in self.splits(reading, model).into_iter().take(3) {
            let mut next = model.clone();
            let spot = next.spots[index];
            let half = |sign: f64| Spot {
                u: [0, 1].map(|k| spot.u[k] + sign * SPLIT * direction[k]),
                a: 0.5 * spot.a,
            };
            next.spots[index] = half(1.0);
            next.spots.push(half(-1.0));
            if self.consider(reading, model, next) {
                return;
            }
        }
        if reading.is_explained(model) {
            return;
        }
        let Some(peak) = peaks.first() else { return };
        let mut weakest: Vec<usize> = (0..model.spots.len()).collect();
        weakest.sort_by(|&i, &j| model.spots[i].a.total_cmp(&model.spots[j].a));
        for index in weakest.into_iter().take(3) {
            let mut next = model.clone();
            next.spots[index] = Spot { u: peak.u, a: peak.a };
            if self.consider(reading, model, next) {
                return;
            }
        }
    }

    /// Merges and drops.
    pub fn shrink(&mut self, reading: &Reading, model: &mut Model) {
        loop {
            let n = model.spots.len();
            let mut pairs: Vec<(f64, usize, usize)> = (0..n)
                .flat_map(|i| (0..i).map(move |j| (i, j)))
                .map(|(i, j)| {
                    let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
                    (d[0].hypot(d[1]), i, j)
                })
                .filter(|p| p.0 < MERGE)
                .collect();
            pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut has_shrunk = false;
            for (_, i, j) in pairs.into_iter().take(3) {
                let (p, q) = (model.spots[i], model.spots[j]);
                if self.separation(reading, model, i, j) > 8.0 * self.factor * self.price {
                    continue;
                }
                let mut next = model.clone();
                let total = p.a + q.a;
                next.spots[j] = Spot {
                    u: [0, 1].map(|k| (p.a * p.u[k] + q.a * q.u[k]) / total),
                    a: total,
                };
                next.spots.remove(i);
                if self.consider(reading, model, next) {
                    has_shrunk = true;
                    break;
                }
            }
            if !has_shrunk && n > 0 {
                let significance = self.significance(reading, model);
                let weakest = (0..n)
                    .min_by(|&i, &j| significance[i].total_cmp(&significance[j]))
                    .expect("not empty");
                if significance[weakest] < 4.0 * self.factor * self.price {
                    let mut next = model.clone();
                    next.spots.remove(weakest);
                    has_shrunk = self.consider(reading, model, next);
                }
            }
            if !has_shrunk {
                break;
            }
        }
    }

    /// Squared amplitude over its variance, for each spot (Wald's test).
    fn significance(&mut self, reading: &Reading, model: &mut Model) -> Vec<f64> {
        let (p, n) = (model.parameters(), model.spots.len());
        self.fitter.information(reading, model);
        let mut cov = Vec::new();
        if !self.fitter.covariance(p, n, 1e-9, &mut cov) {
            return vec![0.0; n];
        }
        (0..n)
            .map(|i| model.spots[i].a.powi(2) / cov[(3 * i + 2) * p + 3 * i + 2].max(1e-300))
            .collect()
    }

    /// Rise of the deviance, to second order, when spots i and j become one.
    fn separation(&mut self, reading: &Reading, model: &mut Model, i: usize, j: usize) -> f64 {
        let (p, n) = (model.parameters(), model.spots.len());
        self.fitter.information(reading, model);
        let mut cov = Vec::new();
        if !self.fitter.covariance(p, n, 1e-9, &mut cov) {
            return 0.0;
        }
        let at = |a: usize, r: usize, b: usize, c: usize| cov[(3 * a + r) * p + 3 * b + c];
        let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
        let s = [0, 1].map(|r| [0, 1].map(|c| at(i, r, i, c) + at(j, r, j, c) - at(i, r, j, c) - at(j, r, i, c)));
        let det = s[0][0] * s[1][1] - s[0][1] * s[1][0];
        (d[0] * d[0] * s[1][1] - 2.0 * d[0] * d[1] * s[0][1] + d[1] * d[1] * s[0][0]) / det.max(1e-300)
    }

    /// Spots whose residual is bent as that of two, with the direction they lie in; the most bent first.
    fn splits(&mut self, reading: &Reading, model: &mut Model) -> Vec<(usize, [f64; 2])> {
        let mut bent: Vec<(f64, usize, [f64; 2])> = self
            .fitter
            .curvatures(reading, model)
            .into_iter()
            .enumerate()
            .filter_map(|(i, [xx, xy, yy])| {
                let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
                let largest = mean + half.hypot(xy);
                let angle = 0.5 * xy.atan2(half);
                (largest > 0.0).then(|| (largest, i, [angle.cos(), angle.sin()]))
            })
            .collect();
        bent.sort_by(|a, b| b.0.total_cmp(&a.0));
        bent.into_iter().map(|(_, i, d)| (i, d)).collect()
    }
}
