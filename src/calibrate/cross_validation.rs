//! Cross-validation: the error of the configured estimator on frames that the fit did not use.

use jiff::Timestamp;
use ndarray::Array2;
use serde::Serialize;

use super::truth::Beacon;
use crate::assign::assign;
use crate::estimate::Estimator;
use crate::frame::Frame;
use crate::stats::median;

/// Distance to the nearest emitter beyond which a beacon counts as missed, m.
const CUTOFF_M: f64 = 25.0;

/// Localisation error of an estimator on the beacons.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Beacons in the frames.
    pub beacons: usize,
    /// Beacons without an emitter within the cutoff.
    pub missed: usize,
    /// Mean of min(squared distance, cutoff²), m²: a missed beacon costs the cutoff.
    pub cost_m2: f64,
    /// Mean squared distance of the others, m².
    pub mse_m2: f64,
    /// Median squared distance of the others, m².
    pub median_m2: f64,
    /// Median squared distance that the estimator's own covariances predict, m².
    pub noise_median_m2: f64,
}

/// Runs an estimator over frames and compares its emitters with the beacons. Surplus emitters cost nothing, because frames may
/// hold sources without a surveyed position.
pub fn score(estimator: &mut dyn Estimator, frames: &[(usize, &Array2<f64>)], beacons: &[Beacon]) -> Score {
    let (mut squared, mut variances) = (Vec::new(), Vec::new());
    let mut total = 0;
    for (index, pixels) in frames {
        let here: Vec<&Beacon> = beacons.iter().filter(|b| b.frame == *index).collect();
        total += here.len();
        let frame = Frame {
            index: *index as u64,
            time: Timestamp::UNIX_EPOCH,
            pixels: (*pixels).clone(),
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        // All beacons of an unusable frame count as missed, with either calibration.
        let Ok(estimate) = estimator.estimate(&frame) else {
            continue;
        };
        let found = &estimate.emitters;
        let distance2 = |b: usize, e: usize| {
            (here[b].ground_m[0] - found[e].x_m).powi(2) + (here[b].ground_m[1] - found[e].y_m).powi(2)
        };
        let matching = assign(here.len(), found.len(), CUTOFF_M * CUTOFF_M, distance2);
        squared.extend(matching.pairs.iter().map(|&(b, e)| distance2(b, e)));
        let variance = |e: usize| found[e].cov_m2[0][0] + found[e].cov_m2[1][1];
        variances.extend(matching.pairs.iter().map(|&(_, e)| variance(e)));
    }
    let missed = total - squared.len();
    let sum: f64 = squared.iter().sum();
    Score {
        beacons: total,
        missed,
        cost_m2: (sum + missed as f64 * CUTOFF_M * CUTOFF_M) / total as f64,
        mse_m2: sum / squared.len() as f64,
        median_m2: median(squared).unwrap_or(f64::NAN),
        // A squared distance with two equal variances of sum v is exponential with mean v.
        noise_median_m2: std::f64::consts::LN_2 * median(variances).unwrap_or(f64::NAN),
    }
}
