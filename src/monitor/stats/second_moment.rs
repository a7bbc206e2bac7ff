//! Whether a spot is wider than one beam's: a score test (Rao, 1948) of its second moments, summed over frames.

use nalgebra::{Matrix3, Vector3};

use super::block_history::{BlockHistory, RECENT_FRAMES, Recent};
use super::moment_blocks::Blocks;
use super::moment_score::MomentScore;
use super::robust::median_high;
use super::widening::{Widening, widening};

/// Windows of newest frames that are tested: the shortest for a strong second beam, the longest for one that no frame shows. They
/// share data, and no correction is made for their number (the soaks of docs/verdicts.md hold the rate of false alerts).
const WINDOWS: [usize; 5] = [3, 10, 20, 40, RECENT_FRAMES];
/// Frames before a window that it is compared with at least. More delay the first verdict, fewer compare with a past as noisy as
/// the window. Not measured.
const MIN_FRAMES_BEFORE: u32 = 30;
/// Standard deviation of a beam's drift until its blocks show it, σ²: a user who walks for ten seconds is seen through another
/// part of the lens. Larger hides a second beam, smaller takes the lens for one. Not measured.
const ASSUMED_DRIFT: f64 = 0.004;
/// Smallest drift, however steady the blocks, σ². Not measured.
const MIN_DRIFT: f64 = 0.002;
/// Standard deviation of honest moments about what all beams show, σ²: a lens is not the same everywhere. Larger hides a second
/// beam that was there from the start. Not measured.
pub const LENS_SCATTER: f64 = 0.1;
/// Age in frames from which a frame counts for the scatter of frames: a second beam that has just come on is no scatter. Longer
/// learns later, shorter takes a second beam for scatter. Not measured.
const SETTLED: usize = 20;
/// Frames over which the scatter is averaged: as long as the blocks reach back.
const MEMORY: f64 = 1200.0;
/// Other beams from which their median is taken for what all beams share. Fewer give no scatter about their median.
const MIN_OTHERS: usize = 3;
/// Largest squared Mahalanobis distance that one frame counts for (winsorised): a bird is one event. Smaller hides a strong
/// second beam for longer; χ² of three degrees exceeds it 15 times in 10⁶.
const MAX_FRAME: f64 = 25.0;
/// A beam's second moments. Two beams d apart, with shares w and 1 − w of the light, have w(1 − w)·d² along the line between them,
/// however they fade; frames add up what none of them shows.
#[derive(Clone, Debug, Default)]
pub struct SecondMomentTest {
    recent: Recent<MomentScore>,
    past: BlockHistory<MomentScore>,
    /// Of the full blocks of the past.
    blocks: Blocks,
    /// Mean squared Mahalanobis distance of a frame from those before, over its expectation, and the frames it is of.
    dispersion: f64,
    dispersion_frames: f64,
    windows: [Option<WindowEstimate>; WINDOWS.len()],
}

/// Moments of a window, and their rise over what came before it, each with its covariance.
#[derive(Clone, Copy, Debug)]
struct WindowEstimate {
    level: (Vector3<f64>, Matrix3<f64>),
    rise: Option<(Vector3<f64>, Matrix3<f64>)>,
}

/// What the other beams show in each window.
#[derive(Clone, Copy, Debug, Default)]
pub struct CommonMode([CommonWindow; WINDOWS.len()]);

#[derive(Clone, Copy, Debug, Default)]
struct CommonWindow {
    level: (Vector3<f64>, Matrix3<f64>),
    rise: (Vector3<f64>, Matrix3<f64>),
}

impl SecondMomentTest {
    /// Takes a frame. With `learn` the frame that it pushes out of the newest is added to the past.
    pub fn push(&mut self, frame: &MomentScore, learn: bool) {
        let expected = self.mean().unwrap_or_default();
        let Some(frame) = frame.within(expected, MAX_FRAME) else {
            return;
        };
        let old = self.recent.push(frame);
        if learn {
            self.learn_dispersion(expected);
            if let Some(old) = old
                && self.past.push(|block| block.add(&old))
            {
                self.blocks = Blocks::of(self.past.blocks());
            }
        }
        self.update_windows();
    }

    /// Forgets the newest frames, not the past.
    pub fn restart(&mut self) {
        self.recent = Recent::default();
        self.update_windows();
    }

    fn learn_dispersion(&mut self, expected: Vector3<f64>) {
        let settled = self.recent.iter().rev().nth(SETTLED);
        if let Some(distance2) = settled.and_then(|m| m.distance2(expected)) {
            self.dispersion_frames = (self.dispersion_frames + 1.0).min(MEMORY);
            self.dispersion += (distance2 / 3.0 - self.dispersion) / self.dispersion_frames;
        }
    }

    /// The mean of all frames, where they are enough.
    fn mean(&self) -> Option<Vector3<f64>> {
        let recent = self.recent.len() as u32;
        let mut sum = self.past_sum();
        self.recent.iter().for_each(|m| sum.add(m));
        let (mean, _) = (self.past.frames() + recent >= MIN_FRAMES_BEFORE).then(|| sum.solved())??;
        Some(mean)
    }

    fn past_sum(&self) -> MomentScore {
        let mut sum = self.blocks.sum;
        sum.add(self.past.filling());
        sum
    }

    /// Everything before the newest frames of each window, where that is enough.
    fn before(&self) -> [Option<MomentScore>; WINDOWS.len()] {
        let mut sum = self.past_sum();
        let mut frames = self.recent.iter();
        let mut before = [None; WINDOWS.len()];
        for (n, before) in WINDOWS.iter().zip(&mut before).rev() {
            let Some(old) = self.recent.len().checked_sub(*n) else {
                continue;
            };
            let taken = self.recent.len() - frames.len();
            frames.by_ref().take(old - taken).for_each(|m| sum.add(m));
            *before = (self.past.frames() + old as u32 >= MIN_FRAMES_BEFORE).then_some(sum);
        }
        before
    }

    /// The newest frames, as many as each window has, where there are so many.
    fn newest(&self) -> [Option<MomentScore>; WINDOWS.len()] {
        let mut sum = MomentScore::default();
        let mut frames = self.recent.iter().rev();
        WINDOWS.map(|n| {
            let taken = self.recent.len() - frames.len();
            frames.by_ref().take(n - taken).for_each(|m| sum.add(m));
            (n <= self.recent.len()).then_some(sum)
        })
    }

    /// Standard deviation of the blocks' means beyond their noise.
    fn drift(&self) -> f64 {
        self.blocks.scatter.map_or(ASSUMED_DRIFT, |(square, noise)| {
            let beyond = square - noise * self.dispersion.max(1.0);
            (beyond / 3.0).max(0.0).sqrt().max(MIN_DRIFT)
        })
    }

    fn update_windows(&mut self) {
        let dispersion = self.dispersion.max(1.0);
        let drift = Matrix3::identity() * self.drift().powi(2);
        let mut windows = self.newest().into_iter().zip(self.before()).map(|(newest, before)| {
            let (mean, cov) = newest?.solved()?;
            let cov = cov * dispersion;
            let before = before.and_then(|sum| sum.solved());
            Some(WindowEstimate {
                level: (mean, cov),
                rise: before.map(|(past, past_cov)| (mean - past, cov + past_cov * dispersion + drift)),
            })
        });
        self.windows = std::array::from_fn(|_| windows.next().flatten());
    }

    /// The most significant window, as it is against the other beams or by its rise against its own past; with or without what the others
    /// show, whichever says less: that may be their noise.
    pub fn most_significant(&self, common: &CommonMode) -> Widening {
        let mut most = Widening::default();
        let lens = Matrix3::identity() * LENS_SCATTER.powi(2);
        for (window, common) in self.windows.iter().zip(&common.0) {
            let Some(window) = window else { break };
            let level = Some(((window.level.0, window.level.1 + lens), common.level));
            let rise = window.rise.map(|rise| (rise, common.rise));
            for ((own, cov), (shared, shared_cov)) in level.into_iter().chain(rise) {
                let more = |off: Vector3<f64>, cov: Matrix3<f64>| {
                    let inverse = cov.try_inverse()?;
                    // No direction explains more than all there is.
                    let can_be_more = 0.5 * off.dot(&(inverse * off)) > most.neg_log_p;
                    let found = can_be_more.then(|| widening(off, inverse));
                    found.filter(|found| found.neg_log_p > most.neg_log_p)
                };
                if let Some(whole) = more(own, cov)
                    && let Some(less) = more(own - shared, cov + shared_cov)
                {
                    most = if less.neg_log_p < whole.neg_log_p { less } else { whole };
                }
            }
        }
        most
    }
}

impl CommonMode {
    /// Medians over `others`, where there are enough, with their own uncertainty.
    pub fn of<'a>(others: impl Iterator<Item = &'a SecondMomentTest> + Clone) -> Self {
        Self(std::array::from_fn(|k| {
            let windows = || others.clone().filter_map(|b| b.windows[k].as_ref());
            CommonWindow {
                level: middle(windows().map(|w| w.level.0).collect()),
                rise: middle(windows().filter_map(|w| Some(w.rise.as_ref()?.0)).collect()),
            }
        }))
    }
}

/// Component-wise median of three or more, and its variance from their scatter (1.4826·MAD, π/2 for a median).
pub fn middle(of: Vec<Vector3<f64>>) -> (Vector3<f64>, Matrix3<f64>) {
    if of.len() < MIN_OTHERS {
        return (Vector3::zeros(), Matrix3::zeros());
    }
    let axis = |k: usize| {
        let middle = median_high(of.iter().map(|m| m[k])).unwrap_or(0.0);
        let scatter = 1.4826 * median_high(of.iter().map(|m| (m[k] - middle).abs())).unwrap_or(0.0);
        (
            middle,
            std::f64::consts::FRAC_PI_2 * scatter * scatter / of.len() as f64,
        )
    };
    let [x, xy, y] = [0, 1, 2].map(axis);
    (
        Vector3::new(x.0, xy.0, y.0),
        Matrix3::from_diagonal(&Vector3::new(x.1, xy.1, y.1)),
    )
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::estimate;

    /// Frames of a beam of SNR 40, moments to 0.07 σ², whose moments are `truth`.
    fn frames(n: usize, truth: [f64; 3], seed: u64) -> Vec<MomentScore> {
        let information = [200.0, 400.0, 200.0];
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..n)
            .map(|_| {
                let score = std::array::from_fn(|k| {
                    let z: f64 = StandardNormal.sample(&mut rng);
                    information[k] * truth[k] + z * f64::sqrt(information[k])
                });
                let [xx, xy, yy] = information;
                let information = [[xx, 0.0, 0.0], [0.0, xy, 0.0], [0.0, 0.0, yy]];
                MomentScore::of(&estimate::SecondMomentScore { score, information }, 1.0)
            })
            .collect()
    }

    fn pushed(frames: &[MomentScore]) -> SecondMomentTest {
        let mut test = SecondMomentTest::default();
        frames.iter().for_each(|m| test.push(m, true));
        test
    }

    fn neg_log_p(test: &SecondMomentTest) -> f64 {
        test.most_significant(&CommonMode::default()).neg_log_p
    }

    #[test]
    fn the_common_mode_needs_three_others() {
        let of = |n: usize| middle((0..n).map(|k| Vector3::new(k as f64, 0.0, 0.0)).collect());
        assert_eq!(of(2).0, Vector3::zeros());
        let (middle, cov) = of(3);
        // Median 1, MAD 1: 1.4826²·π/2/3.
        assert_eq!(middle.x, 1.0);
        let expected = 1.4826f64.powi(2) * std::f64::consts::FRAC_PI_2 / 3.0;
        assert!((cov[(0, 0)] - expected).abs() < 1e-12 && cov[(1, 1)] == 0.0);
    }

    /// Three others that are narrower by chance, and agree.
    #[test]
    fn what_others_show_adds_nothing() {
        let test = pushed(&frames(600, [0.0; 3], 7));
        let narrow = CommonWindow {
            level: (Vector3::new(-0.5, 0.0, -0.5), Matrix3::zeros()),
            rise: (Vector3::new(-0.5, 0.0, -0.5), Matrix3::zeros()),
        };
        let common = CommonMode([narrow; WINDOWS.len()]);
        assert!(test.most_significant(&common).neg_log_p <= neg_log_p(&test));
    }

    #[test]
    fn one_beam_is_not_significant_whatever_its_shape() {
        let shape = [0.05, -0.02, 0.03];
        let mut most: f64 = 0.0;
        for seed in 0..20 {
            let mut test = SecondMomentTest::default();
            for m in frames(2000, shape, seed) {
                test.push(&m, true);
                most = most.max(neg_log_p(&test));
            }
        }
        assert!((5.0..16.0).contains(&most), "{most}");
    }

    #[test]
    fn a_second_beam_that_no_frame_shows_is_found_in_a_second() {
        // Equal beams a σ apart along the diagonal, after five seconds of one.
        for seed in 0..20 {
            let mut test = pushed(&frames(50, [0.0; 3], seed));
            for m in frames(10, [0.125; 3], 100 + seed) {
                test.push(&m, true);
            }
            let found = test.most_significant(&CommonMode::default());
            assert!(
                found.neg_log_p > 19.0 && (found.trace - 0.25).abs() < 0.1,
                "seed {seed}: {found:?}"
            );
        }
    }

    #[test]
    fn what_all_spots_show_and_a_single_frame_prove_nothing() {
        let mut test = pushed(&frames(600, [0.0; 3], 1));
        let smear = [0.2, 0.0, 0.2];
        for m in frames(10, smear, 2) {
            test.push(&m, false);
        }
        assert!(neg_log_p(&test) > 20.0);
        let others: Vec<SecondMomentTest> = (10..15)
            .map(|seed| {
                let mut other = pushed(&frames(600, [0.0; 3], seed));
                frames(10, smear, 100 + seed).iter().for_each(|m| other.push(m, false));
                other
            })
            .collect();
        assert!(test.most_significant(&CommonMode::of(others.iter())).neg_log_p < 10.0);
        let mut test = pushed(&frames(600, [0.0; 3], 3));
        frames(1, [5.0, 0.0, 5.0], 4).iter().for_each(|m| test.push(m, false));
        assert!(neg_log_p(&test) < 15.0);
    }

    #[test]
    fn a_window_against_its_past_by_hand() {
        // Every frame has information 8 along each axis: 30 frames of none, then 3 of 0.5 along x.
        let frame = |x: f64| {
            let information = [[8.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 0.0, 8.0]];
            let score = [8.0 * x, 0.0, 0.0];
            MomentScore::of(&estimate::SecondMomentScore { score, information }, 1.0)
        };
        let frames: Vec<_> = (0..33).map(|k| frame(if k < 30 { 0.0 } else { 0.5 })).collect();
        let test = pushed(&frames);
        let window = test.windows[0].unwrap();
        let (rise, cov) = window.rise.unwrap();
        assert!((rise - Vector3::new(0.5, 0.0, 0.0)).norm() < 1e-12);
        // 1/24 of the window, 1/240 of the past, and the assumed drift.
        let expected = 1.0 / 24.0 + 1.0 / 240.0 + ASSUMED_DRIFT.powi(2);
        assert!((cov[(0, 0)] - expected).abs() < 1e-12 && (window.level.1[(0, 0)] - 1.0 / 24.0).abs() < 1e-12);
        // The rise is the more significant: the level's variance has a lens's scatter instead of the past.
        let found = test.most_significant(&CommonMode::default());
        let by = |variance: f64| 0.5 * 0.25 / variance - 1.5f64.ln();
        let most = by(expected).max(by(1.0 / 24.0 + LENS_SCATTER.powi(2)));
        assert!(
            (found.neg_log_p - most).abs() < 1e-9 && (found.trace - 0.5).abs() < 1e-9,
            "{found:?}"
        );
    }
}
