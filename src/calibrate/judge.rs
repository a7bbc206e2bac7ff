//! Whether a calibration helps: the program's own estimator on frames that the fit has not seen.

use jiff::Timestamp;
use ndarray::Array2;

use super::truth::Beacon;
use crate::assign::assign;
use crate::estimate::Estimator;
use crate::frame::Frame;

/// A beacon farther than this from every emitter found counts as missed, m.
const CUTOFF_M: f64 = 25.0;

/// How well an estimator finds the beacons.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Score {
    /// Beacons looked for.
    pub beacons: usize,
    /// Beacons without an emitter within the cutoff.
    pub missed: usize,
    /// Mean of min(squared distance, cutoff²), m²: a missed beacon costs the cutoff.
    pub cost_m2: f64,
    /// Mean squared distance of the others, m².
    pub mse_m2: f64,
    /// Median squared distance of the others, m².
    pub median_m2: f64,
}

/// Runs an estimator over frames and holds what it finds to the beacons. Beacons need not be all that shines, so
/// emitters too many cost nothing.
pub fn score(estimator: &mut dyn Estimator, frames: &[(usize, &Array2<f64>)], beacons: &[Beacon]) -> Score {
    let mut squared = Vec::new();
    let mut total = 0;
    for (index, pixels) in frames {
        let here: Vec<&Beacon> = beacons.iter().filter(|b| b.frame == *index).collect();
        total += here.len();
        let frame = Frame {
            index: *index as u64,
            time: Timestamp::UNIX_EPOCH,
            pixels: (*pixels).clone(),
            masked: None,
        };
        // A frame that cannot be used finds nobody, with either calibration.
        let Ok(estimate) = estimator.estimate(&frame) else {
            continue;
        };
        let found = &estimate.emitters;
        let distance2 = |b: usize, e: usize| {
            (here[b].ground_m[0] - found[e].x_m).powi(2) + (here[b].ground_m[1] - found[e].y_m).powi(2)
        };
        let matching = assign(here.len(), found.len(), CUTOFF_M * CUTOFF_M, distance2);
        squared.extend(matching.pairs.iter().map(|&(b, e)| distance2(b, e)));
    }
    let missed = total - squared.len();
    let sum: f64 = squared.iter().sum();
    Score {
        beacons: total,
        missed,
        cost_m2: (sum + missed as f64 * CUTOFF_M * CUTOFF_M) / total as f64,
        mse_m2: sum / squared.len() as f64,
        median_m2: super::believe::median(squared).unwrap_or(f64::NAN),
    }
}
