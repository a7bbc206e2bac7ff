//! Posterior mean along ill-determined directions. Overlapping sources have a curved region of nearly equal likelihood; known powers
//! decide which position in it is the most probable, and the mean over it has the least squared error.

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model_order::map_search::ASSIGNMENT_SLACK;
use crate::estimate::model_order::proposals::close_pairs;
use crate::estimate::model_order::search::{Search, TRIAL_STEPS};
use crate::estimate::uncertainty::pixel_posterior::WIDE_PIXEL;

/// Factors on the energy priors' precision, one fit each.
const TIGHTNESS: [f64; 2] = [100.0, 10.0];
/// Sources within this distance, σ, are first fitted with a tight prior.
const OVERLAP_DISTANCE: f64 = 2.0;
/// A direction is ill-determined from this standard deviation on, σ.
const MIN_DEVIATION: f64 = 0.02;
/// Directions that are searched, the distances in standard deviations, and the largest distance in σ.
const DIRECTIONS: usize = 2;
const DISTANCES: [f64; 4] = [-2.0, 2.0, -5.0, 5.0];
const MAX_DISTANCE: f64 = 1.0;
/// Rounds of the power iteration.
const ITERATIONS: usize = 20;

/// Step of the profile in standard deviations, most steps to either side, and the rise of −2 ln probability that ends it.
const STEP: f64 = 0.5;
const STEPS: usize = 12;
const NEGLIGIBLE: f64 = 14.0;
/// The profile constraint's standard deviation is this many times smaller than the direction's.
const NARROWNESS: f64 = 4.0;
/// Steps of the fit at each point of the profile.
const FEW_STEPS: usize = 8;

/// Profile constraint: Σ direction·u = `at` with a precision.
#[derive(Clone)]
pub(crate) struct ProfileConstraint {
    direction: Vec<f64>,
    at: f64,
    precision: f64,
}

/// Posterior mean of a source's position less its mode, σ, and covariance, σ².
#[derive(Clone, Copy)]
pub(crate) struct PosteriorMoments {
    pub shift: [f64; 2],
    pub covariance: [[f64; 2]; 2],
}

impl ProfileConstraint {
    fn beyond(&self, sources: &[PointSource]) -> f64 {
        let places = sources.iter().flat_map(|s| s.u);
        self.direction.iter().zip(places).map(|(d, u)| d * u).sum::<f64>() - self.at
    }

    /// Adds the constraint to the normal equations of `p` parameters.
    pub fn add_normal_equations(&self, sources: &[PointSource], gradient: &mut [f64], hessian: &mut [f64], p: usize) {
        let beyond = self.beyond(sources);
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
    /// The constraint's part of the deviance.
    pub(crate) fn constraint_deviance(&self, sources: &[PointSource]) -> f64 {
        self.profile_constraint
            .as_ref()
            .map_or(0.0, |t| t.precision * t.beyond(sources).powi(2))
    }
}

impl Search {
    /// Refits `hypothesis` with tight energy priors that are loosened step by step: the posterior may have several maxima, and the one
    /// nearest to the fit without the prior need not be the highest.
    fn fit_with_tight_prior(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        let Some(prior) = self.prior.take() else { return };
        let mut next = hypothesis.clone();
        prior.assign_components(&mut next, ASSIGNMENT_SLACK);
        for times in TIGHTNESS {
            let mut tight = next.clone();
            for power in tight.sources.iter_mut().filter_map(|s| s.power.as_mut()) {
                power.precision *= times;
            }
            self.fitter.fit(compressed, &mut tight, TRIAL_STEPS);
            for (source, tight) in next.sources.iter_mut().zip(&tight.sources) {
                (source.u, source.a) = (tight.u, tight.a);
            }
        }
        self.prior = Some(prior);
        self.try_accept_map(compressed, hypothesis, next);
    }

    /// Searches for a more probable optimum: with tight energy priors where sources overlap, and from positions displaced along the
    /// ill-determined directions.
    pub(crate) fn explore_ill_determined(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        if !close_pairs(hypothesis, OVERLAP_DISTANCE).is_empty() {
            self.fit_with_tight_prior(compressed, hypothesis);
        }
        let mut places = self.position_covariance(compressed, hypothesis);
        for _ in 0..DIRECTIONS {
            let Some((deviation, direction)) = ill_determined_direction(&mut places) else {
                return;
            };
            let largest = direction.iter().fold(0.0, |a: f64, d| a.max(d.abs()));
            for far in DISTANCES {
                let length = (far * deviation).clamp(-MAX_DISTANCE / largest, MAX_DISTANCE / largest);
                let mut next = hypothesis.clone();
                for (u, d) in next.sources.iter_mut().flat_map(|s| &mut s.u).zip(&direction) {
                    *u += length * d;
                }
                self.try_accept_map(compressed, hypothesis, next);
            }
        }
    }

    /// Covariance of all positions, σ², (2 N, 2 N); empty where the information is singular.
    fn position_covariance(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> Vec<f64> {
        let (n, p) = (2 * hypothesis.sources.len(), hypothesis.parameters());
        self.fitter.compute_information(compressed, hypothesis);
        let mut covariance = Vec::new();
        if n == 0 || !self.fitter.covariance(p, n / 2, 1.0, &mut covariance) {
            return Vec::new();
        }
        let of = |k: usize| 3 * (k / 2) + k % 2;
        (0..n * n).map(|k| covariance[of(k / n) * p + of(k % n)]).collect()
    }

    /// Posterior means and covariances of the positions along the least determined direction. `None` where all directions are well
    /// determined, and where pixels are so wide that [`pixel_posterior`](crate::estimate::uncertainty::pixel_posterior) applies.
    pub(crate) fn posterior_moments(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
    ) -> Option<Vec<PosteriorMoments>> {
        let pitch = self.fitter.bx.pitch().max(self.fitter.by.pitch());
        if pitch > WIDE_PIXEL {
            return None;
        }
        let mut places = self.position_covariance(compressed, hypothesis);
        let (deviation, direction) = ill_determined_direction(&mut places)?;
        let points = self.profile_along(compressed, hypothesis, deviation, &direction);
        self.fitter.profile_constraint = None;
        self.fitter.fit(compressed, hypothesis, 0);
        let best = points.iter().map(|s| s.score).fold(f64::INFINITY, f64::min);
        let weights: Vec<f64> = points.iter().map(|s| (-0.5 * (s.score - best)).exp()).collect();
        let whole: f64 = weights.iter().sum();
        let centre = |i: usize| {
            let mean = |f: &dyn Fn(&ProfilePoint) -> f64| {
                points.iter().zip(&weights).map(|(s, w)| w / whole * f(s)).sum::<f64>()
            };
            let away = |s: &ProfilePoint, k: usize| s.places[i][k] - hypothesis.sources[i].u[k];
            let shift = [0, 1].map(|k| mean(&|s| away(s, k)));
            let spread = |r: usize, c: usize| {
                mean(&|s| s.covariances[i][r][c] + (away(s, r) - shift[r]) * (away(s, c) - shift[c]))
            };
            PosteriorMoments {
                shift,
                covariance: [0, 1].map(|r| [0, 1].map(|c| spread(r, c))),
            }
        };
        (whole > 0.0).then(|| (0..hypothesis.sources.len()).map(centre).collect())
    }

    /// The profile from `mode` to both sides along a direction: all else is refitted at each point and integrated as a normal density
    /// (Laplace). Ends where points are improbable or two sources would change places.
    fn profile_along(
        &mut self,
        compressed: &CompressedFrame,
        mode: &Hypothesis,
        deviation: f64,
        direction: &[f64],
    ) -> Vec<ProfilePoint> {
        let (n, p) = (mode.sources.len(), mode.parameters());
        let profile_constraint = ProfileConstraint {
            direction: direction.to_vec(),
            at: 0.0,
            precision: (NARROWNESS / deviation).powi(2),
        };
        let start = profile_constraint.beyond(&mode.sources);
        let mut points: Vec<ProfilePoint> = Vec::new();
        let mut best = f64::INFINITY;
        let mut covariance = Vec::new();
        for side in [1.0, -1.0] {
            let mut next = mode.clone();
            for k in usize::from(side < 0.0)..=STEPS {
                let at = start + side * k as f64 * STEP * deviation;
                self.fitter.profile_constraint = Some(ProfileConstraint {
                    at,
                    ..profile_constraint.clone()
                });
                self.fitter.fit(compressed, &mut next, FEW_STEPS);
                self.fitter.compute_information(compressed, &mut next);
                let Some(log_det) = self.fitter.log_det(p, &vec![[0.0; 3]; n]) else {
                    break;
                };
                let score =
                    next.deviance + next.prior_penalty() + self.fitter.constraint_deviance(&next.sources) + log_det;
                best = best.min(score);
                let is_probable = score < best + NEGLIGIBLE && !self.is_exhausted();
                if !is_probable || has_swapped(mode, &next) || !self.fitter.covariance(p, n, 0.0, &mut covariance) {
                    break;
                }
                let block = |i: usize| [0, 1].map(|r| [0, 1].map(|c| covariance[(3 * i + r) * p + 3 * i + c]));
                points.push(ProfilePoint {
                    score,
                    places: next.sources.iter().map(|s| s.u).collect(),
                    covariances: (0..n).map(block).collect(),
                });
            }
        }
        points
    }
}

/// A point of the profile: −2 ln of its probability, the positions there, σ, and their covariances across the direction, σ².
struct ProfilePoint {
    score: f64,
    places: Vec<[f64; 2]>,
    covariances: Vec<[[f64; 2]; 2]>,
}

/// Standard deviation along the least determined direction, and the direction, which is removed from the covariance; `None` where all
/// are well determined.
fn ill_determined_direction(places: &mut [f64]) -> Option<(f64, Vec<f64>)> {
    let (variance, direction) = deflate_leading_eigenpair(places);
    (variance > MIN_DEVIATION * MIN_DEVIATION).then(|| (variance.sqrt(), direction))
}

/// Whether two sources have changed places.
fn has_swapped(mode: &Hypothesis, next: &Hypothesis) -> bool {
    let between = |m: &Hypothesis, i: usize, j: usize| [0, 1].map(|k| m.sources[i].u[k] - m.sources[j].u[k]);
    (0..mode.sources.len()).any(|i| {
        (0..i).any(|j| {
            let (a, b) = (between(mode, i, j), between(next, i, j));
            a[0] * b[0] + a[1] * b[1] < 0.0
        })
    })
}

/// The largest eigenvalue of a symmetric matrix and its eigenvector by power iteration; both are removed from the matrix.
fn deflate_leading_eigenpair(matrix: &mut [f64]) -> (f64, Vec<f64>) {
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
    use super::deflate_leading_eigenpair;

    #[test]
    fn the_leading_directions_come_one_after_the_other() {
        // 9 along (1, 2, 2)/3 and 4 along (2, 1, -2)/3.
        let (u, v) = ([1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0], [2.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]);
        let mut matrix: Vec<f64> = (0..9)
            .map(|k| 9.0 * u[k / 3] * u[k % 3] + 4.0 * v[k / 3] * v[k % 3])
            .collect();
        for (expected, axis) in [(9.0, u), (4.0, v)] {
            let (value, direction) = deflate_leading_eigenpair(&mut matrix);
            let along: f64 = direction.iter().zip(axis).map(|(a, b)| a * b).sum();
            assert!((value - expected).abs() < 1e-6, "{value}");
            assert!((along.abs() - 1.0).abs() < 1e-6, "{direction:?}");
        }
    }
}
