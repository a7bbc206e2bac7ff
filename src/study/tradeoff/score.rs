//! Scores of one estimator in one cell.

use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::Error;
use super::networks::{Candidate, Training};
use super::scene::{Cell, Scene};
use crate::assign::ospa;
use crate::estimate::{self, ESTIMATORS, EstimatorSpec};

/// OSPA's cutoff, m.
pub(in crate::study) const CUTOFF_M: f64 = 25.0;
/// An emitter is resolvable where its bound's root is below this share of the distance to the next and below 10 m.
const RESOLVABLE_SHARE: f64 = 0.1;
const RESOLVABLE_M: f64 = 10.0;

/// The study's file: rows are identified by cell, estimator, frames and seed.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Study {
    pub rows: Vec<Row>,
}

/// One estimator in one cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    pub cell: Cell,
    #[serde(alias = "rung")]
    pub estimator: String,
    pub frames: usize,
    pub seed: u64,
    /// Of the network, where the study was given one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub training: Option<Training>,
    /// Squared error over matched pairs, both axes summed; none where nothing was matched.
    pub mean_m2: Option<f64>,
    /// 95 % confidence interval of the mean.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_interval_m2: Option<[f64; 2]>,
    pub median_m2: Option<f64>,
    /// Mean of the smallest 95 %.
    pub trimmed_m2: Option<f64>,
    /// Median of the emitters' Cramér–Rao bounds.
    pub bound_median_m2: Option<f64>,
    /// Mean over all emitters of the bound for who knows what users send with and that they are in view.
    #[serde(default)]
    pub known_bound_mean_m2: Option<f64>,
    /// Mean of squared error over bound among resolvable emitters, the largest 5 % left out and the mean of a χ² variate
    /// of two degrees of freedom so trimmed divided out: 1 is at the bound.
    pub bound_ratio: Option<f64>,
    pub ospa_m: f64,
    /// In all frames together.
    #[serde(default)]
    pub emitters: usize,
    pub missed: usize,
    pub invented: usize,
    /// Share of frames with the number of emitters right; the same among frames with all emitters resolvable.
    pub count_right: f64,
    pub count_right_resolvable: Option<f64>,
    /// Share of emitters that can be resolved at all.
    pub resolvable: f64,
    pub latency_median_us: f64,
    pub latency_p99_us: f64,
}

/// Mean of an exponential variate's smallest 95 %: (1 − 0.05(1 + ln 20))/0.95.
const TRIMMED_EXPONENTIAL: f64 = 0.842_329_8;

pub(super) fn measure(cell: &Cell, candidate: &Candidate, scenes: &[Scene], seed: u64) -> Result<Row, Error> {
    let camera = cell.camera()?;
    let config = estimate::Config {
        name: Some(candidate.estimator.to_owned()),
        network: candidate.network.as_ref().map(|n| n.path.clone()),
        known_power: Some(cell.known_power(&camera)),
        ..Default::default()
    };
    let mut estimator = estimate::build(&config, &camera)?;
    let (mut squared, mut ratios, mut bounds, mut known_bounds, mut latencies) =
        (vec![], vec![], vec![], vec![], vec![]);
    let mut of_frames = Vec::with_capacity(scenes.len());
    let (mut total_ospa, mut missed, mut invented) = (0.0, 0, 0);
    let (mut right, mut clear, mut clear_right, mut resolvable) = (0, 0, 0, 0);
    if let Some(scene) = scenes.first() {
        // Scratch memory grows with the first frame.
        let _ = estimator.estimate(&scene.frame);
    }
    for scene in scenes {
        let clock = Instant::now();
        let found = estimator.estimate(&scene.frame);
        latencies.push(clock.elapsed().as_secs_f64() * 1e6);
        let positions: Vec<[f64; 2]> = found
            .map(|e| e.emitters.iter().map(|m| [m.x_m, m.y_m]).collect())
            .unwrap_or_default();
        let answer = Answer::new(scene, &positions);
        total_ospa += answer.ospa_m;
        missed += answer.missed;
        invented += answer.invented;
        let is_resolvable: Vec<bool> = (0..scene.positions.len()).map(|i| is_resolvable(scene, i)).collect();
        let is_clear = is_resolvable.iter().all(|&r| r);
        right += usize::from(answer.is_right);
        clear += usize::from(is_clear);
        clear_right += usize::from(is_clear && answer.is_right);
        resolvable += is_resolvable.iter().filter(|r| **r).count();
        bounds.extend_from_slice(&scene.bound_m2);
        known_bounds.extend_from_slice(&scene.known_bound_m2);
        squared.extend_from_slice(&answer.squared_m2);
        of_frames.push((answer.squared_m2.iter().sum(), answer.squared_m2.len()));
        ratios.extend_from_slice(&answer.ratios);
    }
    let frames = scenes.len();
    for values in [&mut squared, &mut bounds, &mut latencies] {
        values.sort_by(f64::total_cmp);
    }
    let emitters = bounds.len().max(1);
    Ok(Row {
        cell: *cell,
        estimator: candidate.label(),
        training: candidate.training(),
        frames,
        seed,
        mean_m2: mean(&squared),
        mean_interval_m2: interval(&of_frames, seed),
        median_m2: quantile(&squared, 0.5),
        trimmed_m2: trimmed(&squared),
        bound_median_m2: quantile(&bounds, 0.5),
        known_bound_mean_m2: mean(&known_bounds),
        bound_ratio: bound_ratio(ratios),
        ospa_m: total_ospa / frames.max(1) as f64,
        emitters,
        missed,
        invented,
        count_right: right as f64 / frames.max(1) as f64,
        count_right_resolvable: (clear > 0).then(|| clear_right as f64 / clear as f64),
        resolvable: resolvable as f64 / emitters as f64,
        latency_median_us: quantile(&latencies, 0.5).unwrap_or(0.0),
        latency_p99_us: quantile(&latencies, 0.99).unwrap_or(0.0),
    })
}

/// 95 % confidence interval of the mean over pairs, from each frame's sum and number of pairs: percentiles of the bootstrap over frames
/// (Efron 1979), since pairs of one frame are not independent and few carry the mean. `None` where nothing is paired.
fn interval(of_frames: &[(f64, usize)], seed: u64) -> Option<[f64; 2]> {
    /// Percentiles of 2.5 and 97.5 are then those of 25 values each.
    const RESAMPLES: usize = 1000;
    if of_frames.iter().all(|(_, pairs)| *pairs == 0) {
        return None;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .filter_map(|_| {
            let drawn = (0..of_frames.len()).map(|_| of_frames[random.random_range(0..of_frames.len())]);
            let (sum, pairs) = drawn.fold((0.0, 0), |(sum, pairs), (s, p)| (sum + s, pairs + p));
            (pairs > 0).then(|| sum / pairs as f64)
        })
        .collect();
    means.sort_by(f64::total_cmp);
    Some([quantile(&means, 0.025)?, quantile(&means, 0.975)?])
}

/// How an answer compares with the truth of its frame.
pub(in crate::study) struct Answer {
    pub ospa_m: f64,
    pub missed: usize,
    pub invented: usize,
    /// Whether the number of emitters is right.
    pub is_right: bool,
    /// Squared error over matched pairs, both axes summed, m².
    pub squared_m2: Vec<f64>,
    /// The same over the bound, among resolvable emitters.
    pub ratios: Vec<f64>,
}

impl Answer {
    pub fn new(scene: &Scene, positions: &[[f64; 2]]) -> Self {
        let score = ospa(&scene.positions, positions, CUTOFF_M);
        let (mut squared_m2, mut ratios) = (Vec::new(), Vec::new());
        for &(i, j) in &score.matching.pairs {
            let (t, p) = (scene.positions[i], positions[j]);
            let error = (t[0] - p[0]).powi(2) + (t[1] - p[1]).powi(2);
            squared_m2.push(error);
            if is_resolvable(scene, i) {
                ratios.push(error / scene.bound_m2[i]);
            }
        }
        Self {
            ospa_m: score.distance_m,
            missed: score.matching.unmatched_rows.len(),
            invented: score.matching.unmatched_columns.len(),
            is_right: positions.len() == scene.positions.len(),
            squared_m2,
            ratios,
        }
    }
}

/// Mean of squared errors over their bounds, the largest 5 % left out; see [`Row::bound_ratio`].
pub(in crate::study) fn bound_ratio(ratios: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut ratios: Vec<f64> = ratios.into_iter().collect();
    ratios.sort_by(f64::total_cmp);
    trimmed(&ratios).map(|r| r / TRIMMED_EXPONENTIAL)
}

impl Scene {
    /// Whether all emitters can be resolved.
    pub fn is_clear(&self) -> bool {
        (0..self.positions.len()).all(|i| is_resolvable(self, i))
    }
}

fn is_resolvable(scene: &Scene, i: usize) -> bool {
    is_apart(&scene.positions, &scene.bound_m2, i)
}

/// Whether an emitter's bound tells it apart from the next.
pub(in crate::study) fn is_apart(positions: &[[f64; 2]], bound_m2: &[f64], i: usize) -> bool {
    let p = positions[i];
    let others = positions.iter().enumerate().filter(|(j, _)| *j != i);
    let nearest = others
        .map(|(_, q)| (p[0] - q[0]).hypot(p[1] - q[1]))
        .fold(f64::INFINITY, f64::min);
    let error = bound_m2[i].sqrt();
    error < RESOLVABLE_SHARE * nearest && error < RESOLVABLE_M
}

pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

fn trimmed(sorted: &[f64]) -> Option<f64> {
    mean(&sorted[..(sorted.len() as f64 * 0.95).ceil() as usize])
}

fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    sorted
        .get(((sorted.len().max(1) - 1) as f64 * share).round() as usize)
        .copied()
}

/// The estimators of single frames: each of the trade-off's frames is a scene of its own.
pub(in crate::study) fn of_single_frames() -> impl Iterator<Item = &'static EstimatorSpec> {
    ESTIMATORS.iter().filter(|r| !r.remembers())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_of_a_mean_holds_it_as_often_as_it_says() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        // Frames of one to three pairs with exponential errors of mean 2.
        let held = (0..400).filter(|k| {
            let mut frame = || {
                let pairs = random.random_range(1..4);
                let sum: f64 = (0..pairs).map(|_| -2.0 * (1.0 - random.random::<f64>()).ln()).sum();
                (sum, pairs)
            };
            let frames: Vec<_> = (0..200).map(|_| frame()).collect();
            let [low, high] = interval(&frames, *k).unwrap();
            (low..high).contains(&2.0)
        });
        // Within three standard deviations of 95 %.
        let held = held.count();
        assert!((367..=393).contains(&held), "{held} of 400");
        assert_eq!(interval(&[(0.0, 0)], 1), None);
    }
}
