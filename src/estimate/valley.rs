//! Other lowest places of a bent valley. Where spots melt, many places explain a frame nearly as well, and which of them is the most
//! probable is up to the known powers: a fit that begins at what explains the frame best ends in the nearest of them.

use super::model::Model;
use super::posterior::LENIENCY;
use super::reading::Reading;
use super::search::{Search, TRIAL_STEPS};

/// How many times tighter energies are held to the known ones, step by step.
const TIGHT: [f64; 2] = [100.0, 10.0];
/// Places known better than this, σ, in all directions lie in no valley.
const LEAST: f64 = 0.02;
/// Directions that are looked along, and how far, in standard deviations and, at most, in σ.
const DIRECTIONS: usize = 2;
const FAR: [f64; 4] = [-2.0, 2.0, -5.0, 5.0];
const FARTHEST: f64 = 1.0;
/// Rounds of the power iteration.
const ITERATIONS: usize = 20;

impl Search {
    /// Fits `model` anew from where its places come to lie with energies all but fixed to the known ones, which are then let go by
    /// degrees: a valley that bends has more than one lowest place, and the one next to what was fitted without the prior need not
    /// be the lowest.
    pub(super) fn tighten(&mut self, reading: &Reading, model: &mut Model) {
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

    /// Fits `model` anew from places along the directions in which it is known least.
    pub(super) fn wander(&mut self, reading: &Reading, model: &mut Model) {
        let (n, p) = (model.spots.len(), model.parameters());
        self.fitter.information(reading, model);
        let mut covariance = Vec::new();
        if !self.fitter.covariance(p, n, 1.0, &mut covariance) {
            return;
        }
        let at = |i: usize| 3 * (i / 2) + i % 2;
        let mut places: Vec<f64> = (0..4 * n * n).map(|k| covariance[at(k / (2 * n)) * p + at(k % (2 * n))]).collect();
        for _ in 0..DIRECTIONS {
            let (variance, direction) = leading(&mut places);
            let deviation = variance.sqrt();
            if !(deviation > LEAST) {
                return;
            }
            let largest = direction.iter().fold(0.0, |a: f64, d| a.max(d.abs()));
            for far in FAR {
                let length = (far * deviation).clamp(-FARTHEST / largest, FARTHEST / largest);
                let mut next = model.clone();
                for (i, d) in direction.iter().enumerate() {
                    next.spots[i / 2].u[i % 2] += length * d;
                }
                self.attempt(reading, model, next);
            }
        }
    }
}

/// The largest eigenvalue of a symmetric matrix and its eigenvector, both taken out of the matrix (power iteration).
fn leading(matrix: &mut [f64]) -> (f64, Vec<f64>) {
    let n = matrix.len().isqrt();
    let widest = (0..n).max_by(|&i, &j| matrix[i * (n + 1)].total_cmp(&matrix[j * (n + 1)])).unwrap_or(0);
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
