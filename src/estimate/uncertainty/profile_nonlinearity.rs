//! Likelihood nonlinearity: whether the deviance is quadratic as the covariance assumes. For overlapping sources it is often curved.

use crate::estimate::dense_linalg::dot;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::evaluate;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::uncertainty::covariance::Covariance;

/// Distance of the test points, in standard deviations.
const OUT: f64 = 2.0;
/// Largest factor between the rise of the deviance and the covariance's prediction, either way.
const FACTOR: f64 = 2.0;
/// Below this standard deviation, σ, nonlinearity does not matter: the profile is a parabola over so short a way.
const SHORT: f64 = 0.01;

/// Whether the deviance rises as the covariance predicts along the least determined direction of source `i`, with all other
/// parameters moved by their regression on it.
pub(crate) fn is_likelihood_quadratic(
    context: &mut FitContext,
    hypothesis: &Hypothesis,
    covariance: &Covariance,
    i: usize,
) -> bool {
    let angle = 0.5 * (2.0 * covariance.at(i, 0, i, 1)).atan2(covariance.at(i, 0, i, 0) - covariance.at(i, 1, i, 1));
    let (sin, cos) = angle.sin_cos();
    let along = |j: usize, r: usize| dot(&[covariance.at(j, r, i, 0), covariance.at(j, r, i, 1)], &[cos, sin]);
    let std = dot(&[along(i, 0), along(i, 1)], &[cos, sin]).max(0.0).sqrt();
    if std < SHORT {
        return true;
    }
    let mut at = hypothesis.clone();
    evaluate(context, &mut at);
    let lowest = at.deviance;
    [-OUT, OUT].iter().all(|out| {
        for (j, (moved, source)) in at.sources.iter_mut().zip(&hypothesis.sources).enumerate() {
            for r in 0..2 {
                moved.u[r] = source.u[r] + out / std * along(j, r);
            }
        }
        evaluate(context, &mut at);
        let rise = (at.deviance - lowest) / (OUT * OUT);
        (1.0 / FACTOR..FACTOR).contains(&rise)
    })
}
