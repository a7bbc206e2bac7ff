//! Posterior mean along ill-determined directions. Overlapping sources have a curved region of nearly equal likelihood; known powers
//! decide which position in it is the most probable, and the mean over it has the least squared error.

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::{evaluate, fit_problem, linearise};
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::profile_constraint::ProfileConstraint;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::uncertainty::covariance::{Covariance, log_det};
use crate::estimate::uncertainty::ill_determined::{ill_determined_direction, position_covariance};
use crate::estimate::uncertainty::pixel_posterior::WIDE_PIXEL;

/// Step of the profile in standard deviations, most steps to either side, and the rise of −2 ln probability that ends it: what lies beyond
/// has 1e-3 of the mode's weight. Shorter steps cost a fit each.
const STEP: f64 = 0.5;
const STEPS: usize = 12;
const NEGLIGIBLE: f64 = 14.0;
/// The profile constraint's standard deviation is this many times smaller than the direction's: it then blurs the profile by 3 %.
const NARROWNESS: f64 = 4.0;
/// Steps of the fit at each point of the profile.
const FEW_STEPS: usize = 8;

/// Posterior mean of a source's position less its mode, σ, and covariance, σ².
#[derive(Clone, Copy)]
pub(crate) struct PosteriorMoments {
    pub shift: [f64; 2],
    pub covariance: [[f64; 2]; 2],
}

/// A point of the profile: −2 ln of its probability, the positions there, σ, and their covariances across the direction, σ².
struct ProfilePoint {
    score: f64,
    places: Vec<[f64; 2]>,
    covariances: Vec<[[f64; 2]; 2]>,
}

/// Posterior means and covariances of the positions along the least determined direction. `None` where all directions are well
/// determined, and where pixels are so wide that [`pixel_posterior`](crate::estimate::uncertainty::pixel_posterior) applies.
pub(crate) fn posterior_moments(
    context: &mut FitContext,
    hypothesis: &mut Hypothesis,
) -> Option<Vec<PosteriorMoments>> {
    if context.bases.pitch() > WIDE_PIXEL {
        return None;
    }
    let mut places = position_covariance(context, hypothesis);
    let (deviation, direction) = ill_determined_direction(&mut places)?;
    let points = profile_along(context, hypothesis, deviation, direction);
    evaluate(context, hypothesis);
    let best = points.iter().map(|s| s.score).fold(f64::INFINITY, f64::min);
    let weights: Vec<f64> = points.iter().map(|s| (-0.5 * (s.score - best)).exp()).collect();
    let whole: f64 = weights.iter().sum();
    let centre = |i: usize| {
        let mean =
            |f: &dyn Fn(&ProfilePoint) -> f64| points.iter().zip(&weights).map(|(s, w)| w / whole * f(s)).sum::<f64>();
        let away = |s: &ProfilePoint, k: usize| s.places[i][k] - hypothesis.sources[i].u[k];
        let shift = [0, 1].map(|k| mean(&|s| away(s, k)));
        let spread =
            |r: usize, c: usize| mean(&|s| s.covariances[i][r][c] + (away(s, r) - shift[r]) * (away(s, c) - shift[c]));
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
    context: &mut FitContext,
    mode: &Hypothesis,
    deviation: f64,
    direction: Vec<f64>,
) -> Vec<ProfilePoint> {
    let n = mode.sources.len();
    let mut constraint = ProfileConstraint {
        direction,
        at: 0.0,
        precision: (NARROWNESS / deviation).powi(2),
    };
    let start = constraint.beyond(&mode.sources);
    let mut points: Vec<ProfilePoint> = Vec::new();
    let mut best = f64::INFINITY;
    for side in [1.0, -1.0] {
        let mut next = mode.clone();
        for k in usize::from(side < 0.0)..=STEPS {
            constraint.at = start + side * k as f64 * STEP * deviation;
            let problem = Problem {
                constraint: Some(&constraint),
                ..context.problem()
            };
            fit_problem(context, problem, &mut next, FEW_STEPS);
            let equations = linearise(problem, &mut next, context.budget, context.workspace).equations;
            let Some(log_det) = log_det(equations, &vec![[0.0; 3]; n]) else {
                break;
            };
            let score = next.deviance + next.prior_penalty() + constraint.deviance(&next.sources) + log_det;
            best = best.min(score);
            let is_probable = score < best + NEGLIGIBLE && !context.budget.is_exhausted();
            if !is_probable || has_swapped(mode, &next) {
                break;
            }
            let Some(covariance) = Covariance::new(equations, 0.0) else {
                break;
            };
            points.push(ProfilePoint {
                score,
                places: next.sources.iter().map(|s| s.u).collect(),
                covariances: (0..n).map(|i| covariance.block(i, i)).collect(),
            });
        }
    }
    points
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
