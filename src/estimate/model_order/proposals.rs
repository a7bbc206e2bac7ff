//! The moves that change the number of emitters: add, split, relocate, merge, drop.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot};
use crate::estimate::model_order::search::{Search, TRIAL_STEPS};
use crate::estimate::uncertainty::pixel_posterior::WIDE;
use crate::estimate::uncertainty::split_score_test::Split;

/// Steps that a chosen model may take before it is reported.
const FINAL_STEPS: usize = 200;
/// Two greedy peaks of one round stand at least this far apart, σ.
const SEPARATION: f64 = 2.5;
/// Spots nearer than this, σ, may be one.
const MERGE: f64 = 2.5;
/// Where pixels are wide, spots nearer than so many of them may be one, whatever the second order says.
const MERGE_PIXELS: f64 = 1.6;
/// Pairs that are tried as one, a round, and where pixels are wide.
const PAIRS: [usize; 2] = [3, 8];
/// Nearer, the second order does not tell how far apart two spots are.
const CLOSE: f64 = 0.15;
/// A spot that is brought inside comes to lie so far from the edge, σ.
const INSIDE: f64 = 1.0;
/// The faintest spots that are tried to be done without for it.
const SPARE: usize = 3;
/// Spots that are tried to be done without, a round.
const FAINTEST: usize = 6;
/// A split that promises this share of an emitter's price is tried though the frame is explained without.
const LIKELY: f64 = 0.6;
/// A split puts its halves at least and at most this far to either side, σ.
const SPLIT: [f64; 2] = [0.4, 1.0];

impl Search {
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

    pub(crate) fn finish(&mut self, reading: &Reading, model: &mut Model) {
        if !model.converged {
            self.fitter.fit(reading, model, FINAL_STEPS);
        }
    }

    /// Tries `next` and keeps it where it is better.
    pub(crate) fn consider(&mut self, reading: &Reading, model: &mut Model, mut next: Model) -> bool {
        if next.spots.len() > reading.most_spots() || self.is_exhausted() {
            return false;
        }
        if self.prior.is_some() {
            return self.attempt(reading, model, next);
        }
        let bar = self.bar(model, &next);
        self.fitter.fit_below(reading, &mut next, TRIAL_STEPS, bar);
        let is_better = self.score(&next) < self.score(model) - 1e-6;
        if is_better {
            *model = next;
        }
        is_better
    }

    pub(crate) fn residual_peaks(
        &mut self,
        reading: &Reading,
        model: &mut Model,
    ) -> &[crate::estimate::detect::matched_filter::Peak] {
        self.residual.clear();
        self.residual.extend_from_slice(self.fitter.residual_of(reading, model));
        let (mx, my) = (reading.mx, reading.my);
        // A peak's share that other spots have absorbed comes back in the joint fit: look a little lower.
        let threshold = 0.7 * (self.factor * self.price).sqrt();
        self.heatmap.peaks(&self.residual, mx, my, threshold, SEPARATION)
    }

    /// Adds, splits and relocates.
    pub(crate) fn grow(&mut self, reading: &Reading, model: &mut Model) {
        let peaks: Vec<_> = self.residual_peaks(reading, model).iter().take(2).copied().collect();
        for peak in &peaks {
            let mut next = model.clone();
            next.spots.push(Spot::new(peak.u, peak.a));
            if self.consider(reading, model, next) {
                break;
            }
        }
        for split in self.splits(reading, model).into_iter().take(3) {
            let is_likely = split.gain > LIKELY * self.factor * self.price;
            if reading.is_explained(model) && !is_likely {
                break;
            }
            if self.consider(reading, model, halved(model, &split)) {
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
            next.spots[index] = Spot::new(peak.u, peak.a);
            if self.consider(reading, model, next) {
                return;
            }
        }
    }

    /// Merges and drops.
    pub fn shrink(&mut self, reading: &Reading, model: &mut Model) {
        while self.merge_several(reading, model) {}
        let pitch = self.fitter.bx.pitch().max(self.fitter.by.pitch());
        let is_wide = pitch > WIDE;
        let limit = if is_wide {
            MERGE.max(MERGE_PIXELS * pitch)
        } else {
            MERGE
        };
        loop {
            let n = model.spots.len();
            let mut has_shrunk = false;
            for (d, i, j) in pairs(model, limit).into_iter().take(PAIRS[usize::from(is_wide)]) {
                if !is_wide && d > CLOSE && self.separation(reading, model, i, j) > 8.0 * self.factor * self.price {
                    continue;
                }
                let next = merged(model, &[(i, j)]);
                if self.consider(reading, model, next) {
                    has_shrunk = true;
                    break;
                }
            }
            if !has_shrunk {
                // The least significant may be one of a pair that cannot be told apart, and needed.
                let significance = self.significance(reading, model);
                let mut faint: Vec<usize> = (0..n).collect();
                faint.retain(|&i| significance[i] < 4.0 * self.factor * self.price);
                faint.sort_by(|&i, &j| significance[i].total_cmp(&significance[j]));
                for index in faint.into_iter().take(FAINTEST) {
                    let mut next = model.clone();
                    next.spots.remove(index);
                    if self.consider(reading, model, next) {
                        has_shrunk = true;
                        break;
                    }
                }
            }
            if !has_shrunk && !self.pull_in(reading, model) {
                break;
            }
        }
    }

    /// Does without a spot where one beyond the sensor's edge comes inside: with a second, what little is seen of it may stand in for
    /// one that the edge cuts.
    fn pull_in(&mut self, reading: &Reading, model: &mut Model) -> bool {
        if !reading.is_explained(model) {
            return false;
        }
        let axes = [&self.fitter.bx, &self.fitter.by];
        let ends = axes.map(|b| [b.edges[0], b.edges[b.n]]);
        let is_outside = |i: usize| (0..2).any(|k| !(ends[k][0]..=ends[k][1]).contains(&model.spots[i].u[k]));
        let outside: Vec<usize> = (0..model.spots.len()).filter(|&i| is_outside(i)).collect();
        let mut spare: Vec<usize> = (0..model.spots.len()).collect();
        spare.sort_by(|&i, &j| model.spots[i].a.total_cmp(&model.spots[j].a));
        spare.truncate(SPARE);
        spare.extend(&outside);
        for &k in &outside {
            for &i in spare.iter().filter(|&&i| i != k) {
                let mut next = model.clone();
                for (u, [low, high]) in next.spots[k].u.iter_mut().zip(ends) {
                    let inside = INSIDE.min(0.5 * (high - low));
                    *u = u.max(low + inside).min(high - inside);
                }
                next.spots.remove(i);
                if self.consider(reading, model, next) {
                    return true;
                }
            }
        }
        false
    }

    /// Merges all pairs at once that the frame does not tell apart, where there are several.
    fn merge_several(&mut self, reading: &Reading, model: &mut Model) -> bool {
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        for (_, i, j) in pairs(model, MERGE) {
            let is_free = chosen
                .iter()
                .all(|&(a, b)| ![a, b].contains(&i) && ![a, b].contains(&j));
            if is_free && self.separation(reading, model, i, j) < self.factor * self.price {
                chosen.push((i, j));
            }
        }
        chosen.len() > 1 && self.consider(reading, model, merged(model, &chosen))
    }

    /// Squared amplitude over its variance, for each spot (Wald's test).
    pub(crate) fn significance(&mut self, reading: &Reading, model: &mut Model) -> Vec<f64> {
        let (p, n) = (model.parameters(), model.spots.len());
        if !self.assure(reading, model) {
            return vec![0.0; n];
        }
        let cov = &self.certainty.covariance;
        (0..n)
            .map(|i| model.spots[i].a.powi(2) / cov[(3 * i + 2) * p + 3 * i + 2].max(1e-300))
            .collect()
    }

    /// Rise of the deviance, to second order, when spots i and j become one.
    fn separation(&mut self, reading: &Reading, model: &mut Model, i: usize, j: usize) -> f64 {
        let p = model.parameters();
        if !self.assure(reading, model) {
            return 0.0;
        }
        let cov = &self.certainty.covariance;
        let at = |a: usize, r: usize, b: usize, c: usize| cov[(3 * a + r) * p + 3 * b + c];
        let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
        let s = [0, 1].map(|r| [0, 1].map(|c| at(i, r, i, c) + at(j, r, j, c) - at(i, r, j, c) - at(j, r, i, c)));
        let det = s[0][0] * s[1][1] - s[0][1] * s[1][0];
        (d[0] * d[0] * s[1][1] - 2.0 * d[0] * d[1] * s[0][1] + d[1] * d[1] * s[0][0]) / det.max(1e-300)
    }

    /// Splits that the residual asks for, the most promising first.
    pub(crate) fn splits(&mut self, reading: &Reading, model: &mut Model) -> Vec<Split> {
        let is_known = self.certainty.is_of(model);
        if self.is_exhausted() || !self.assure(reading, model) {
            return Vec::new();
        }
        if let Some(known) = &self.certainty.splits {
            return known.clone();
        }
        if is_known {
            self.fitter.information(reading, model);
        }
        let bends = self.fitter.bends(reading, model, &self.certainty.covariance);
        let mut splits: Vec<_> = bends.iter().enumerate().filter_map(|(i, b)| b.split(i)).collect();
        splits.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        self.certainty.splits = Some(splits.clone());
        splits
    }

    /// Sets the certainty of `model`; `false` where its information is singular.
    fn assure(&mut self, reading: &Reading, model: &mut Model) -> bool {
        if !self.certainty.is_of(model) {
            self.fitter.information(reading, model);
            let known = &mut self.certainty;
            let (p, n) = (model.parameters(), model.spots.len());
            known.is_regular = self.fitter.covariance(p, n, 1e-9, &mut known.covariance);
            known.splits = None;
            known.deviance = model.deviance;
            known.nuisances = model.nuisances;
            known.spots.clone_from(&model.spots);
        }
        self.certainty.is_regular
    }
}

/// What is known of how well one hypothesis is known: moves ask for it several times.
#[derive(Default)]
pub(crate) struct Certainty {
    spots: Vec<Spot>,
    nuisances: Nuisances,
    deviance: f64,
    is_regular: bool,
    covariance: Vec<f64>,
    splits: Option<Vec<Split>>,
}

impl Certainty {
    /// The deviance tells frames and their weights apart.
    fn is_of(&self, model: &Model) -> bool {
        self.deviance == model.deviance && self.nuisances == model.nuisances && self.spots == model.spots
    }
}

/// `model` with two halves of a spot to either side of it.
fn halved(model: &Model, split: &Split) -> Model {
    let mut next = model.clone();
    let spot = model.spots[split.index];
    let distance = split.distance.clamp(SPLIT[0], SPLIT[1]);
    let half = |sign: f64| {
        let u = [0, 1].map(|k| spot.u[k] + sign * distance * split.direction[k]);
        Spot::new(u, 0.5 * spot.a)
    };
    next.spots[split.index] = half(1.0);
    next.spots.push(half(-1.0));
    next
}

/// Pairs of spots nearer than `limit`, σ, with their distance; the nearest first.
pub(crate) fn pairs(model: &Model, limit: f64) -> Vec<(f64, usize, usize)> {
    let n = model.spots.len();
    let mut pairs: Vec<(f64, usize, usize)> = (0..n)
        .flat_map(|i| (0..i).map(move |j| (i, j)))
        .map(|(i, j)| {
            let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
            (d[0].hypot(d[1]), i, j)
        })
        .filter(|p| p.0 < limit)
        .collect();
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
}

/// `model` with spot j < i of each pair where the light of both is centred, and without i.
pub(crate) fn merged(model: &Model, pairs: &[(usize, usize)]) -> Model {
    let mut next = model.clone();
    for &(i, j) in pairs {
        let (p, q) = (model.spots[i], model.spots[j]);
        let total = p.a + q.a;
        next.spots[j] = Spot::new([0, 1].map(|k| (p.a * p.u[k] + q.a * q.u[k]) / total), total);
    }
    let mut k = 0;
    next.spots.retain(|_| {
        k += 1;
        pairs.iter().all(|&(i, _)| i != k - 1)
    });
    next
}
