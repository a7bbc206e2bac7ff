//! Whether the likelihood is what a covariance says it is: melted emitters lie in bent valleys, and a covariance is straight.

use crate::estimate::dense_linalg::dot;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Model;
use crate::estimate::model_order::search::Search;

/// How far out is looked, in standard deviations.
const OUT: f64 = 2.0;
/// The deviance out there may be this many times what the covariance says, or as many times less.
const FACTOR: f64 = 2.0;
/// A valley no longer than this, σ, is straight.
const SHORT: f64 = 0.01;

impl Search {
    /// Whether the deviance along the direction in which spot `i` is known least, all else following as the covariance of the
    /// `model`'s parameters says, rises as it says too.
    pub(crate) fn is_straight(&mut self, reading: &Reading, model: &Model, covariance: &[f64], i: usize) -> bool {
        let p = model.parameters();
        let at = |r: usize, c: usize| covariance[(3 * i + r) * p + 3 * i + c];
        let angle = 0.5 * (2.0 * at(0, 1)).atan2(at(0, 0) - at(1, 1));
        let (sin, cos) = angle.sin_cos();
        let along = |r: usize| dot(&covariance[r * p + 3 * i..][..2], &[cos, sin]);
        let std = dot(&[along(3 * i), along(3 * i + 1)], &[cos, sin]).max(0.0).sqrt();
        if std < SHORT {
            return true;
        }
        let mut at = model.clone();
        self.fitter.fit(reading, &mut at, 0);
        let lowest = at.deviance;
        [-OUT, OUT].iter().all(|out| {
            for (j, (moved, spot)) in at.spots.iter_mut().zip(&model.spots).enumerate() {
                for r in 0..2 {
                    moved.u[r] = spot.u[r] + out / std * along(3 * j + r);
                }
            }
            self.fitter.fit(reading, &mut at, 0);
            let rise = (at.deviance - lowest) / (OUT * OUT);
            (1.0 / FACTOR..FACTOR).contains(&rise)
        })
    }
}
