//! Other lowest places of a bent valley. Where spots melt, many places explain a frame nearly as well, and which of them is the most
//! probable is up to the known powers: a fit that begins at what explains the frame best ends in the nearest of them.

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Spot};
use crate::estimate::model_order::map_search::LENIENCY;
use crate::estimate::model_order::proposals::pairs;
use crate::estimate::model_order::search::{Search, TRIAL_STEPS};
use crate::estimate::uncertainty::pixel_posterior::WIDE;

/// How many times tighter energies are held to the known ones, step by step.
const TIGHT: [f64; 2] = [100.0, 10.0];
/// Spots nearer than this, σ, touch.
const TOUCHING: f64 = 2.0;
/// Places known better than this, σ, in all directions lie in no valley.
const LEAST: f64 = 0.02;
/// Directions that are looked along, and how far, in standard deviations and, at most, in σ.
const DIRECTIONS: usize = 2;
const FAR: [f64; 4] = [-2.0, 2.0, -5.0, 5.0];
const FARTHEST: f64 = 1.0;
/// Rounds of the power iteration.
const ITERATIONS: usize = 20;

/// Steps along a valley, in standard deviations, how many to either side at most, and what is too improbable to count.
const STEP: f64 = 0.5;
const STEPS: usize = 12;
const NEGLIGIBLE: f64 = 14.0;
/// How much narrower than the valley is long a tether is.
const NARROW: f64 = 4.0;
/// Steps of a fit from one place of the valley to the next.
const FEW_STEPS: usize = 8;

/// Holds places to a line across a valley: Σ direction·u = `at` with a precision.
#[derive(Clone)]
pub(crate) struct Tether {
    direction: Vec<f64>,
    at: f64,
    precision: f64,
}

/// Where a spot is on average, from where it most probably is, and its covariance, σ and σ².
#[derive(Clone, Copy)]
pub(crate) struct Centre {
    pub shift: [f64; 2],
    pub covariance: [[f64; 2]; 2],
}

impl Tether {
    fn beyond(&self, spots: &[Spot]) -> f64 {
        let places = spots.iter().flat_map(|s| s.u);
        self.direction.iter().zip(places).map(|(d, u)| d * u).sum::<f64>() - self.at
    }

    /// Adds its part of the normal equations of `p` parameters.
    pub fn linearise(&self, spots: &[Spot], gradient: &mut [f64], hessian: &mut [f64], p: usize) {
        let beyond = self.beyond(spots);
        let at = |k: usize| 3 * (k / 2) + k % 2;
        for (k, d) in self.direction.iter().enumerate() {
            gradient[at(k)] -= self.precision * d * beyond;
            for (l, e) in self.direction.iter().enumerate().skip(k) {
                hessian[at(k) * p + at(l)] += self.precision * d * e;
            }
        }
    }
}

impl Fitter {
    /// What the tether adds to the deviance.
    pub(crate) fn strain(&self, spots: &[Spot]) -> f64 {
        self.tether
            .as_ref()
            .map_or(0.0, |t| t.precision * t.beyond(spots).powi(2))
    }
}

impl Search {
    /// Fits `model` anew from where its places come to lie with energies all but fixed to the known ones, which are then let go by
    /// degrees: a valley that bends has more than one lowest place, and the one next to what was fitted without the prior need not
    /// be the lowest.
    fn tighten(&mut self, reading: &Reading, model: &mut Model) {
        let Some(prior) = self.prior.take() else { return };
        let mut next = model.clone();
        prior.label(&mut next, LENIENCY);
        for times in TIGHT {
            let mut tight = next.clone();
            for power in tight.spots.iter_mut().filter_map(|s| s.power.as_mut()) {
                power.precision *= times;
            }
            self.fitter.fit(reading, &mut tight, TRIAL_STEPS);
            for (spot, tight) in next.spots.iter_mut().zip(&tight.spots) {
                (spot.u, spot.a) = (tight.u, tight.a);
            }
        }
        self.prior = Some(prior);
        self.attempt(reading, model, next);
    }

    /// Looks for a more probable place of the valley that `model` may lie in: with energies held tight where spots touch, and from
    /// places along the directions that are known least.
    pub(crate) fn explore(&mut self, reading: &Reading, model: &mut Model) {
        if !pairs(model, TOUCHING).is_empty() {
            self.tighten(reading, model);
        }
        let mut places = self.uncertainty(reading, model);
        for _ in 0..DIRECTIONS {
            let Some((deviation, direction)) = valley(&mut places) else {
                return;
            };
            let largest = direction.iter().fold(0.0, |a: f64, d| a.max(d.abs()));
            for far in FAR {
                let length = (far * deviation).clamp(-FARTHEST / largest, FARTHEST / largest);
                let mut next = model.clone();
                for (u, d) in next.spots.iter_mut().flat_map(|s| &mut s.u).zip(&direction) {
                    *u += length * d;
                }
                self.attempt(reading, model, next);
            }
        }
    }

    /// Covariance of all places, σ², (2 N, 2 N); empty where there is none.
    fn uncertainty(&mut self, reading: &Reading, model: &mut Model) -> Vec<f64> {
        let (n, p) = (2 * model.spots.len(), model.parameters());
        self.fitter.information(reading, model);
        let mut covariance = Vec::new();
        if n == 0 || !self.fitter.covariance(p, n / 2, 1.0, &mut covariance) {
            return Vec::new();
        }
        let of = |k: usize| 3 * (k / 2) + k % 2;
        (0..n * n).map(|k| covariance[of(k / n) * p + of(k % n)]).collect()
    }

    /// Means and covariances of places along the valley that `model` lies in: the position of least squared error is the mean of the
    /// posterior and not its highest place. `None` where there is no valley, and where pixels are so wide that each emitter's
    /// place within its own is averaged over instead.
    pub(crate) fn centres(&mut self, reading: &Reading, model: &mut Model) -> Option<Vec<Centre>> {
        let pitch = self.fitter.bx.pitch().max(self.fitter.by.pitch());
        if pitch > WIDE {
            return None;
        }
        let mut places = self.uncertainty(reading, model);
        let (deviation, direction) = valley(&mut places)?;
        let stops = self.follow(reading, model, deviation, &direction);
        self.fitter.tether = None;
        self.fitter.fit(reading, model, 0);
        let best = stops.iter().map(|s| s.score).fold(f64::INFINITY, f64::min);
        let weights: Vec<f64> = stops.iter().map(|s| (-0.5 * (s.score - best)).exp()).collect();
        let whole: f64 = weights.iter().sum();
        let centre = |i: usize| {
            let mean =
                |f: &dyn Fn(&Stop) -> f64| stops.iter().zip(&weights).map(|(s, w)| w / whole * f(s)).sum::<f64>();
            let away = |s: &Stop, k: usize| s.places[i][k] - model.spots[i].u[k];
            let shift = [0, 1].map(|k| mean(&|s| away(s, k)));
            let spread = |r: usize, c: usize| {
                mean(&|s| s.covariances[i][r][c] + (away(s, r) - shift[r]) * (away(s, c) - shift[c]))
            };
            Centre {
                shift,
                covariance: [0, 1].map(|r| [0, 1].map(|c| spread(r, c))),
            }
        };
        (whole > 0.0).then(|| (0..model.spots.len()).map(centre).collect())
    }

    /// Follows a valley from `mode` to both sides along the direction that is known least, all else fitted anew at each stop and
    /// integrated over as a normal density (Laplace), until stops are improbable or two emitters would change places.
    fn follow(&mut self, reading: &Reading, mode: &Model, deviation: f64, direction: &[f64]) -> Vec<Stop> {
        let (n, p) = (mode.spots.len(), mode.parameters());
        let tether = Tether {
            direction: direction.to_vec(),
            at: 0.0,
            precision: (NARROW / deviation).powi(2),
        };
        let start = tether.beyond(&mode.spots);
        let mut stops: Vec<Stop> = Vec::new();
        let mut best = f64::INFINITY;
        let mut covariance = Vec::new();
        for side in [1.0, -1.0] {
            let mut next = mode.clone();
            for k in usize::from(side < 0.0)..=STEPS {
                let at = start + side * k as f64 * STEP * deviation;
                self.fitter.tether = Some(Tether { at, ..tether.clone() });
                self.fitter.fit(reading, &mut next, FEW_STEPS);
                self.fitter.information(reading, &mut next);
                let Some(log_det) = self.fitter.log_det(p, &vec![[0.0; 3]; n]) else {
                    break;
                };
                let score = next.deviance + next.pull() + self.fitter.strain(&next.spots) + log_det;
                best = best.min(score);
                let is_probable = score < best + NEGLIGIBLE && !self.is_exhausted();
                if !is_probable || has_swapped(mode, &next) || !self.fitter.covariance(p, n, 0.0, &mut covariance) {
                    break;
                }
                let block = |i: usize| [0, 1].map(|r| [0, 1].map(|c| covariance[(3 * i + r) * p + 3 * i + c]));
                stops.push(Stop {
                    score,
                    places: next.spots.iter().map(|s| s.u).collect(),
                    covariances: (0..n).map(block).collect(),
                });
            }
        }
        stops
    }
}

/// A place along a valley: −2 ln of its probability, the spots' places there, σ, and their covariances across the valley, σ².
struct Stop {
    score: f64,
    places: Vec<[f64; 2]>,
    covariances: Vec<[[f64; 2]; 2]>,
}

/// Standard deviation along the direction that is known least, and that direction, which is taken out of the covariance; `None`
/// where all is known well.
fn valley(places: &mut [f64]) -> Option<(f64, Vec<f64>)> {
    let (variance, direction) = leading(places);
    (variance > LEAST * LEAST).then(|| (variance.sqrt(), direction))
}

/// Whether two emitters have come to lie the other way around.
fn has_swapped(mode: &Model, next: &Model) -> bool {
    let between = |m: &Model, i: usize, j: usize| [0, 1].map(|k| m.spots[i].u[k] - m.spots[j].u[k]);
    (0..mode.spots.len()).any(|i| {
        (0..i).any(|j| {
            let (a, b) = (between(mode, i, j), between(next, i, j));
            a[0] * b[0] + a[1] * b[1] < 0.0
        })
    })
}

/// The largest eigenvalue of a symmetric matrix and its eigenvector, both taken out of the matrix (power iteration).
fn leading(matrix: &mut [f64]) -> (f64, Vec<f64>) {
    let n = matrix.len().isqrt();
    let widest = (0..n)
        .max_by(|&i, &j| matrix[i * (n + 1)].total_cmp(&matrix[j * (n + 1)]))
        .unwrap_or(0);
    let mut vector = matrix[widest * n..(widest + 1) * n].to_vec();
    let mut value = 0.0;
    for _ in 0..ITERATIONS {
        let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(length > 0.0) {
            return (0.0, vector);
        }
        for v in &mut vector {
            *v /= length;
        }
        let next: Vec<f64> = matrix
            .chunks_exact(n)
            .map(|row| row.iter().zip(&vector).map(|(m, v)| m * v).sum())
            .collect();
        value = next.iter().zip(&vector).map(|(a, b)| a * b).sum();
        vector = next;
    }
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    for v in &mut vector {
        *v /= length;
    }
    for (i, row) in matrix.chunks_exact_mut(n).enumerate() {
        for (m, v) in row.iter_mut().zip(&vector) {
            *m -= value * vector[i] * v;
        }
    }
    (value, vector)
}

#[cfg(test)]
mod tests {
    use super::leading;

    #[test]
    fn the_leading_directions_come_one_after_the_other() {
        // 9 along (1, 2, 2)/3 and 4 along (2, 1, -2)/3.
        let (u, v) = ([1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0], [2.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]);
        let mut matrix: Vec<f64> = (0..9)
            .map(|k| 9.0 * u[k / 3] * u[k % 3] + 4.0 * v[k / 3] * v[k % 3])
            .collect();
        for (expected, axis) in [(9.0, u), (4.0, v)] {
            let (value, direction) = leading(&mut matrix);
            let along: f64 = direction.iter().zip(axis).map(|(a, b)| a * b).sum();
            assert!((value - expected).abs() < 1e-6, "{value}");
            assert!((along.abs() - 1.0).abs() < 1e-6, "{direction:?}");
        }
    }
}
