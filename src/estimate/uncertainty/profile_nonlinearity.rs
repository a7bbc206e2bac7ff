//! Likelihood nonlinearity: whether the deviance is quadratic as the covariance assumes. For overlapping sources it is often curved.

use crate::estimate::dense_linalg::dot;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::model_order::search::Search;

/// Distance of the test points, in standard deviations.
const OUT: f64 = 2.0;
/// Largest factor between the rise of the deviance and the covariance's prediction, either way.
const FACTOR: f64 = 2.0;
/// Below this standard deviation, σ, nonlinearity does not matter.
const SHORT: f64 = 0.01;

impl Search {
    /// Whether the deviance rises as the covariance predicts along the least determined direction of source `i`, with all other
    /// parameters moved by their regression on it.
    pub(crate) fn is_likelihood_quadratic(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &Hypothesis,
        covariance: &[f64],
        i: usize,
    ) -> bool {
        let p = hypothesis.parameters();
        let at = |r: usize, c: usize| covariance[(3 * i + r) * p + 3 * i + c];
        let angle = 0.5 * (2.0 * at(0, 1)).atan2(at(0, 0) - at(1, 1));
        let (sin, cos) = angle.sin_cos();
        let along = |r: usize| dot(&covariance[r * p + 3 * i..][..2], &[cos, sin]);
        let std = dot(&[along(3 * i), along(3 * i + 1)], &[cos, sin]).max(0.0).sqrt();
        if std < SHORT {
            return true;
        }
        let mut at = hypothesis.clone();
        self.fitter.fit(compressed, &mut at, 0);
        let lowest = at.deviance;
        [-OUT, OUT].iter().all(|out| {
            for (j, (moved, source)) in at.sources.iter_mut().zip(&hypothesis.sources).enumerate() {
                for r in 0..2 {
                    moved.u[r] = source.u[r] + out / std * along(3 * j + r);
                }
            }
            self.fitter.fit(compressed, &mut at, 0);
            let rise = (at.deviance - lowest) / (OUT * OUT);
            (1.0 / FACTOR..FACTOR).contains(&rise)
        })
    }
}
