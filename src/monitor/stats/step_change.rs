use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::Vector2;

use crate::claims::seconds;
use crate::monitor::track::detection::Detection;
use crate::monitor::track::kalman::largest_eigenvalue;

/// Frames of the way before a step, and of the ways after it that are tried.
const BEFORE: usize = 3;
const AFTER: [usize; 2] = [3, 5];
const KEPT: usize = BEFORE + AFTER[AFTER.len() - 1];
/// Frames apart by more than this are no way, s.
const LONGEST_GAP_S: f64 = 0.5;
/// Accelerations of honest users, r.m.s., m/s²: half a g is a hard brake.
const ACCELERATION: f64 = 5.0;
/// Steps of the past that tell how steps scatter: no fewer than the first, no more than the second.
const SCATTER: [usize; 2] = [30, 120];
/// Frames that a step is remembered for.
const MEMORY: usize = 20;
/// A step counts for so much at most: at one false alert a month and five frames a second something else must
/// speak for a second beam too.
const MOST: f64 = 22.0;

/// Whether a spot's centre has stepped aside: who comes on within a user's spot draws it towards themselves between two frames,
/// which no user who walks, drives, brakes or turns does. A line through the positions before, another through those after;
/// where they meet the moment between the two there was no step.
#[derive(Clone, Debug, Default)]
pub struct StepDetector {
    /// Positions and their larger variances.
    newest: VecDeque<(Timestamp, Vector2<f64>, f64)>,
    /// Of each newest frame, and the surprises before those.
    judged: VecDeque<StepEvidence>,
    past: VecDeque<f64>,
}

/// What lies between the two lines, with its variance per axis.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// m.
    pub aside: Vector2<f64>,
    /// Of the first frame after it.
    since: Timestamp,
    variance: f64,
    /// What a turn at either end of the gap adds.
    turn: Vector2<f64>,
    /// A gap's way, m: a frame may have been lost unnoticed.
    way: f64,
}

/// How far aside, how surprising, and since when.
#[derive(Clone, Copy, Debug, Default)]
pub struct StepEvidence {
    pub length_m: f64,
    pub neg_log_p: f64,
    pub since: Option<Timestamp>,
}

/// For each of `AFTER`, where there are frames enough.
pub const TRIED: usize = AFTER.len();
pub type CandidateSteps = [Option<Step>; TRIED];

impl Step {
    /// Held against what all beams have in common. What leaves the disc of the turns is no farther from it than from its own true
    /// point, whose squared distance is χ² of two degrees.
    fn judged(&self, common: Vector2<f64>) -> StepEvidence {
        let aside = self.aside - common;
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
    /// The frame's steps by windows, yet to be held against what all beams have in common.
    pub fn look(&mut self, time: Timestamp, detection: &Detection) -> CandidateSteps {
        if self
            .newest
            .back()
            .is_some_and(|(last, ..)| !(1e-9..LONGEST_GAP_S).contains(&seconds(*last, time)))
        {
            self.newest.clear();
        }
        let variance = largest_eigenvalue(&detection.cov);
        self.newest.push_back((time, detection.position, variance));
        self.newest.drain(..self.newest.len().saturating_sub(KEPT));
        AFTER.map(|after| self.step(after))
    }

    /// Takes the frame's steps, less what all beams have in common of each.
    pub fn note(&mut self, tried: &CandidateSteps, common: &[Vector2<f64>; TRIED], learn: bool) {
        let seen = tried
            .iter()
            .zip(common)
            .filter_map(|(step, common)| Some(step.as_ref()?.judged(*common)));
        let Some(most) = seen.max_by(|a, b| a.neg_log_p.total_cmp(&b.neg_log_p)) else {
            return;
        };
        self.judged.push_back(most);
        if self.judged.len() > MEMORY
            && let Some(old) = self.judged.pop_front()
            && learn
        {
            self.past.push_back(old.neg_log_p);
            self.past.drain(..self.past.len().saturating_sub(SCATTER[1]));
        }
    }

    /// The most surprising step of the newest frames, where the past tells how steps scatter: air and platform move beams about
    /// beyond what the fit's covariance says.
    pub fn most(&self) -> Option<StepEvidence> {
        if self.past.len() < SCATTER[0] {
            return None;
        }
        // One in ten of what is χ² of two degrees, halved, is above ln 10.
        let mut past: Vec<f64> = self.past.iter().copied().collect();
        past.sort_by(f64::total_cmp);
        let usual = past.get(past.len() * 9 / 10)? / std::f64::consts::LN_10;
        let most = self.judged.iter().max_by(|a, b| a.neg_log_p.total_cmp(&b.neg_log_p))?;
        Some(StepEvidence {
            neg_log_p: (most.neg_log_p / usual.max(1.0)).min(MOST),
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
            way: gap * before.pace(),
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
    /// Of the velocity, beyond its noise.
    fn pace(&self) -> f64 {
        (self.slope.norm_squared() - self.slope_variance).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;
    use nalgebra::Matrix2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::estimate::Flags;
    use crate::monitor::stats::second_moment::SecondMomentScore;

    const SIGMA_M: f64 = 0.05;

    /// The most surprising step of a way, seen ten times a second with an error of `SIGMA_M`.
    fn most(way: impl Fn(f64) -> [f64; 2], seed: u64) -> StepEvidence {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut steps = StepDetector::default();
        let mut most = StepEvidence::default();
        for k in 0..100 {
            let t = 0.1 * f64::from(k);
            let noise = Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut rng) }) * SIGMA_M;
            let detection = Detection {
                position: Vector2::from(way(t)) + noise,
                cov: Matrix2::identity() * SIGMA_M * SIGMA_M,
                energy_j: 1e-3,
                flags: Flags::empty(),
                moments: SecondMomentScore::default(),
                snr: 200.0,
                resolution_m: 3.0,
                clutter_probability: 0.0,
            };
            let time = Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(t);
            let tried = steps.look(time, &detection);
            steps.note(&tried, &[Vector2::zeros(); TRIED], true);
            if let Some(step) = steps.most().filter(|s| s.neg_log_p > most.neg_log_p) {
                most = step;
            }
        }
        most
    }

    #[test]
    fn a_metre_aside_between_two_frames_is_a_step_and_told_since_when() {
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
