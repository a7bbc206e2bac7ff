//! Whether a spot's centre has stepped aside between two frames, as it does when a second beam comes on within it.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::Vector2;

use super::jitter::ACCELERATION;
use super::robust::ninth_decile;
use crate::time::seconds;

/// Frames of the line before a step, and of the lines after it that are tried: three are found sooner, five are more exact.
const BEFORE: usize = 3;
const AFTER: [usize; 2] = [3, 5];
const KEPT: usize = BEFORE + AFTER[AFTER.len() - 1];
/// Frames farther apart than this make no line, s: a user brakes or turns in between.
const LONGEST_GAP_S: f64 = 0.5;
/// Past steps that the scatter is estimated from: none is evidence before the first number, none older than the second counts.
/// More know the scatter better, fewer begin sooner and follow the air. Not measured.
const SCATTER: [usize; 2] = [30, 120];
/// Frames for which a step is remembered; the energy and jitter since then add to its evidence. Longer keeps one odd frame
/// as evidence for longer.
const MEMORY: usize = 20;
/// Largest −ln p of a step: at one false alert a month and five frames/s or more it is below the threshold, so that something
/// else must be evidence of a second beam too.
const MAX_NEG_LOG_P: f64 = 22.0;
/// Number of lines after a step that are tried.
pub const TRIED: usize = AFTER.len();
/// For each of `AFTER`, where there are frames enough.
pub type CandidateSteps = [Option<Step>; TRIED];

/// A line through the positions before a moment, another through those after it: where they meet between the two there was no
/// step. Who comes on within a user's spot draws it towards themselves between two frames, which no user who walks, drives,
/// brakes or turns does.
#[derive(Clone, Debug, Default)]
pub struct StepDetector {
    /// Positions and their larger variances.
    newest: VecDeque<(Timestamp, Vector2<f64>, f64)>,
    /// Of each newest frame, and the −ln p of those before.
    found: VecDeque<StepEvidence>,
    past: VecDeque<f64>,
}

/// The gap between the two lines, with its variance per axis.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// m.
    pub aside: Vector2<f64>,
    /// Time of the first frame after it.
    since: Timestamp,
    variance: f64,
    /// What a turn at either end of the gap adds.
    turn: Vector2<f64>,
    /// Distance covered in a gap, m: a frame may have been lost unnoticed.
    way: f64,
}

/// How far aside, −ln p of it, and since when.
#[derive(Clone, Copy, Debug, Default)]
pub struct StepEvidence {
    pub length_m: f64,
    pub neg_log_p: f64,
    pub since: Option<Timestamp>,
}

impl Step {
    /// With or without what all beams have in common, whichever says less: that may be the noise of others.
    fn evidence(&self, common: Vector2<f64>) -> StepEvidence {
        let [less, whole] = [common, Vector2::zeros()].map(|common| self.evidence_of(self.aside - common));
        if less.neg_log_p < whole.neg_log_p { less } else { whole }
    }

    /// The distance from the disc of the turns is no more than from its own true point, whose square is χ² of two degrees.
    fn evidence_of(&self, aside: Vector2<f64>) -> StepEvidence {
        let nearest = -aside.dot(&self.turn) / self.turn.norm_squared().max(f64::MIN_POSITIVE);
        let length_m = (aside + self.turn * nearest.clamp(-1.0, 1.0)).norm();
        let beyond = (length_m - self.way).max(0.0);
        StepEvidence {
            length_m,
            neg_log_p: 0.5 * beyond * beyond / self.variance,
            since: Some(self.since),
        }
    }
}

impl StepDetector {
    /// Takes a position with its larger variance, m²; gives the steps that end now, before what all beams share is known.
    pub fn candidates(&mut self, time: Timestamp, position: Vector2<f64>, variance: f64) -> CandidateSteps {
        if self
            .newest
            .back()
            .is_some_and(|(last, ..)| !(1e-9..LONGEST_GAP_S).contains(&seconds(*last, time)))
        {
            self.newest.clear();
        }
        self.newest.push_back((time, position, variance));
        self.newest.drain(..self.newest.len().saturating_sub(KEPT));
        AFTER.map(|after| self.step(after))
    }

    /// Takes the frame's steps, less what all beams have in common of each.
    pub fn push(&mut self, candidates: &CandidateSteps, common: &[Vector2<f64>; TRIED], learn: bool) {
        let seen = candidates
            .iter()
            .zip(common)
            .filter_map(|(step, common)| Some(step.as_ref()?.evidence(*common)));
        let Some(most) = seen.max_by(|a, b| a.neg_log_p.total_cmp(&b.neg_log_p)) else {
            return;
        };
        self.found.push_back(most);
        if self.found.len() > MEMORY
            && let Some(old) = self.found.pop_front()
            && learn
        {
            self.past.push_back(old.neg_log_p);
            self.past.drain(..self.past.len().saturating_sub(SCATTER[1]));
        }
    }

    /// Forgets the newest frames, not the past.
    pub fn restart(&mut self) {
        self.newest.clear();
        self.found.clear();
    }

    /// The most significant step of the newest frames, once the past shows how steps scatter: air and platform move beams about
    /// beyond what the fit's covariance says.
    pub fn most_significant(&self) -> Option<StepEvidence> {
        if self.past.len() < SCATTER[0] {
            return None;
        }
        // One in ten of χ² of two degrees, halved, is above ln 10.
        let usual = ninth_decile(self.past.iter().copied())? / std::f64::consts::LN_10;
        let most = self.found.iter().max_by(|a, b| a.neg_log_p.total_cmp(&b.neg_log_p))?;
        Some(StepEvidence {
            neg_log_p: (most.neg_log_p / usual.max(1.0)).min(MAX_NEG_LOG_P),
            ..*most
        })
    }

    fn step(&self, after: usize) -> Option<Step> {
        let split = self.newest.len().checked_sub(after).filter(|n| *n >= BEFORE)?;
        let (last, first) = (self.newest[split - 1].0, self.newest[split].0);
        let gap = seconds(last, first);
        let before = self.line(split - BEFORE..split, last, 0.5 * gap);
        let after = self.line(split..self.newest.len(), last, 0.5 * gap);
        Some(Step {
            aside: after.at - before.at,
            since: first,
            variance: before.variance + after.variance,
            turn: (after.slope - before.slope) * (0.5 * gap),
            way: gap * before.speed(),
        })
    }

    /// The line of least squares through some frames, `later` seconds after `origin`.
    fn line(&self, frames: std::ops::Range<usize>, origin: Timestamp, later: f64) -> Line {
        let points = || self.newest.range(frames.clone());
        let n = frames.len() as f64;
        let time = |t: &Timestamp| seconds(origin, *t);
        let mean = points().map(|(t, ..)| time(t)).sum::<f64>() / n;
        let spread: f64 = points().map(|(t, ..)| (time(t) - mean).powi(2)).sum();
        let mut line = Line {
            // What half an acceleration leaves beyond a line.
            variance: (0.5 * ACCELERATION * ((later - mean).powi(2) - spread / n)).powi(2),
            ..Line::default()
        };
        for (t, position, variance) in points() {
            let lever = (time(t) - mean) / spread;
            let weight = 1.0 / n + (later - mean) * lever;
            line.at += position * weight;
            line.slope += position * lever;
            line.variance += weight * weight * variance;
            line.slope_variance += 2.0 * lever * lever * variance;
        }
        line
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Line {
    at: Vector2<f64>,
    variance: f64,
    slope: Vector2<f64>,
    /// Of both components together.
    slope_variance: f64,
}

impl Line {
    /// The velocity's size beyond its noise.
    fn speed(&self) -> f64 {
        (self.slope.norm_squared() - self.slope_variance).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const SIGMA_M: f64 = 0.05;

    fn at(t: f64) -> Timestamp {
        Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(t)
    }

    /// The most significant step of a way, seen ten times a second with an error of `SIGMA_M`.
    fn most(way: impl Fn(f64) -> [f64; 2], seed: u64) -> StepEvidence {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut detector = StepDetector::default();
        let mut most = StepEvidence::default();
        for k in 0..100 {
            let t = 0.1 * f64::from(k);
            let noise = Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut rng) }) * SIGMA_M;
            let tried = detector.candidates(at(t), Vector2::from(way(t)) + noise, SIGMA_M * SIGMA_M);
            detector.push(&tried, &[Vector2::zeros(); TRIED], true);
            if let Some(step) = detector.most_significant().filter(|s| s.neg_log_p > most.neg_log_p) {
                most = step;
            }
        }
        most
    }

    #[test]
    fn a_step_of_exact_positions_is_its_length() {
        let mut detector = StepDetector::default();
        let mut tried = [None; TRIED];
        for k in 0..6 {
            let y = if k < 3 { 0.0 } else { 1.0 };
            tried = detector.candidates(at(0.1 * f64::from(k)), Vector2::new(0.0, y), 1e-4);
        }
        let step = tried[0].expect("three frames before and three after");
        assert!((step.aside - Vector2::new(0.0, 1.0)).norm() < 1e-9, "{step:?}");
        assert_eq!(step.since, at(0.3));
        assert!(tried[1].is_none(), "five after need eight frames");
        // A step that all beams make is none, and what others make adds nothing to this one.
        assert!(step.evidence(Vector2::new(0.0, 1.0)).neg_log_p < 1e-20);
        let alone = step.evidence(Vector2::zeros()).neg_log_p;
        assert_eq!(step.evidence(Vector2::new(0.0, -3.0)).neg_log_p, alone);
    }

    #[test]
    fn a_straight_way_at_any_speed_is_no_step() {
        let mut detector = StepDetector::default();
        let mut tried = [None; TRIED];
        for k in 0..8 {
            tried = detector.candidates(at(0.1 * f64::from(k)), Vector2::new(1.5 * f64::from(k), 0.0), 1e-4);
        }
        for step in tried.into_iter().flatten() {
            assert!(step.aside.norm() < 1e-9, "{step:?}");
        }
    }

    #[test]
    fn a_gap_in_time_begins_a_new_line() {
        let mut detector = StepDetector::default();
        for k in 0..3 {
            detector.candidates(at(0.1 * f64::from(k)), Vector2::zeros(), 1e-4);
        }
        let mut tried = [None; TRIED];
        for k in 0..3 {
            tried = detector.candidates(at(2.0 + 0.1 * f64::from(k)), Vector2::new(0.0, 1.0), 1e-4);
        }
        assert!(tried.iter().all(Option::is_none));
    }

    #[test]
    fn a_metre_aside_between_two_frames_is_a_step_and_dated() {
        for seed in 0..50 {
            let walk = |t: f64| [1.4 * t, if t > 7.95 { 1.0 } else { 0.0 }];
            let step = most(walk, seed);
            let since = step
                .since
                .map(|t| t.duration_since(Timestamp::UNIX_EPOCH).as_secs_f64());
            assert!(step.neg_log_p > 10.0, "seed {seed}: {step:?}");
            assert!((since.unwrap() - 8.0).abs() < 0.11, "seed {seed}: {since:?}");
        }
    }

    #[test]
    fn walking_driving_braking_turning_and_a_lost_frame_are_no_step() {
        let mut worst = [0.0f64; 4];
        for seed in 0..500 {
            let mut rng = ChaCha8Rng::seed_from_u64(1000 + seed);
            let (turn_s, angle) = (rng.random_range(7.0..9.0), rng.random_range(0.0..std::f64::consts::TAU));
            let corner = |pace: f64| {
                move |t: f64| match t < turn_s {
                    true => [pace * (t - turn_s), 0.0],
                    false => [pace * (t - turn_s) * angle.cos(), pace * (t - turn_s) * angle.sin()],
                }
            };
            let brake = |t: f64| [15.0 * t - 2.5 * (t - turn_s).max(0.0).powi(2), 0.0];
            let lost = |t: f64| [15.0 * (t + if t > turn_s { 0.1 } else { 0.0 }), 0.0];
            let seen = [
                most(corner(1.4), seed),
                most(corner(8.0), seed),
                most(brake, seed),
                most(lost, seed),
            ];
            for (worst, seen) in worst.iter_mut().zip(seen) {
                *worst = worst.max(seen.neg_log_p);
            }
        }
        assert!(worst.iter().all(|s| *s < 12.0), "{worst:?}");
    }
}
