use std::collections::VecDeque;

use nalgebra::{Matrix2, Matrix3, Vector3};

use crate::estimate;
use crate::monitor::input::claim_timing::median;

/// Newest frames that a test looks at.
const WINDOWS: [usize; 5] = [3, 10, 20, 40, 80];
const LONGEST: usize = WINDOWS[WINDOWS.len() - 1];
/// Frames before a window that it is held against at least.
const FEWEST: u32 = 30;
/// Frames of a block of the past, and blocks kept: two minutes at 10 frames/s.
const BLOCK: u32 = 30;
const BLOCKS: usize = 40;
/// Blocks from which a beam's slow drift is known, and what it is taken for until then and is never below, σ²: a user who walks
/// for ten seconds sees another part of the lens.
const DRIFT_BLOCKS: usize = 6;
const ASSUMED_DRIFT: f64 = 0.004;
const LEAST_DRIFT: f64 = 0.002;
/// How far honest moments may be from what all beams show, σ²: a lens is not the same everywhere.
const UNLIKE_OTHERS: f64 = 0.1;
/// A frame tells how frames scatter only when it is this old: what has just begun is not scatter.
const SETTLED: usize = 20;
/// Frames that the scatter is remembered over.
const MEMORY: f64 = 1200.0;
/// Other beams whose median tells what befalls everybody.
const FEWEST_OTHERS: usize = 3;
/// One frame's squared Mahalanobis distance counts for no more: a bird is one event.
const MOST: f64 = 25.0;
/// Directions of a second beam that are looked in, over half a turn.
const DIRECTIONS: usize = 16;

/// Whether a spot is wider than one beam's. Two beams d apart, with shares w and 1 − w of the light, have w(1 − w)·d² along the
/// line between them, however they fade; frames add up what none of them shows.
#[derive(Clone, Debug, Default)]
pub struct SecondMomentTest {
    newest: VecDeque<SecondMomentScore>,
    filling: (SecondMomentScore, u32),
    blocks: VecDeque<SecondMomentScore>,
    /// Mean squared Mahalanobis distance of a frame from those before, over its expectation, and the frames it is of.
    dispersion: f64,
    scattered: f64,
    seen: [Option<Seen>; WINDOWS.len()],
}

/// What a window shows, and how far that is above what came before it, each with its covariance.
#[derive(Clone, Copy, Debug)]
struct Seen {
    level: (Vector3<f64>, Matrix3<f64>),
    rise: Option<(Vector3<f64>, Matrix3<f64>)>,
}

/// What the other beams show in each window: what befalls everybody is nobody's second beam.
#[derive(Clone, Copy, Debug, Default)]
pub struct CommonMode([Window; WINDOWS.len()]);

#[derive(Clone, Copy, Debug, Default)]
struct Window {
    level: (Vector3<f64>, Matrix3<f64>),
    rise: (Vector3<f64>, Matrix3<f64>),
}

/// Second moments in information form.
#[derive(Clone, Copy, Debug)]
pub struct SecondMomentScore {
    score: Vector3<f64>,
    information: Matrix3<f64>,
}

impl Default for SecondMomentScore {
    fn default() -> Self {
        Self {
            score: Vector3::zeros(),
            information: Matrix3::zeros(),
        }
    }
}

impl SecondMomentScore {
    /// What a frame says, its covariance times `inflation`.
    pub fn of(bend: &estimate::SecondMomentScore, inflation: f64) -> Self {
        let s = bend.information;
        Self {
            score: Vector3::from(bend.score) / inflation,
            information: Matrix3::from_fn(|r, c| 0.5 * (s[r][c] + s[c][r])) / inflation,
        }
    }

    /// Of light spread by `moments`, σ², of that signal-to-noise ratio. A Gaussian spot f of unit norm has
    /// ‖½f_xx‖² = 1/8 and ‖f_xy‖² = 1/4 with its energy adjusted; the three are orthogonal to each other and to its position.
    pub fn of_spread(moments: Matrix2<f64>, snr: f64) -> Self {
        let information = Matrix3::from_diagonal(&Vector3::new(0.125, 0.25, 0.125)) * (snr * snr);
        Self {
            score: information * Vector3::new(moments[(0, 0)], moments[(0, 1)], moments[(1, 1)]),
            information,
        }
    }

    fn add(&mut self, other: &Self) {
        self.score += other.score;
        self.information += other.information;
    }

    /// The moments and their covariance.
    fn solved(&self) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let cov = self.information.cholesky()?.inverse();
        Some((cov * self.score, cov))
    }

    /// Squared Mahalanobis distance of the moments from `expected`.
    fn distance2(&self, expected: Vector3<f64>) -> Option<f64> {
        let off = self.solved()?.0 - expected;
        Some(off.dot(&(self.information * off)))
    }
}

impl SecondMomentTest {
    pub fn note(&mut self, frame: &SecondMomentScore, learn: bool) {
        let expected = self.before(0).unwrap_or_default();
        let Some(distance2) = frame.distance2(expected).filter(|d| d.is_finite()) else {
            return;
        };
        let mut frame = *frame;
        if distance2 > MOST {
            let usual = frame.information * expected;
            frame.score = usual + (frame.score - usual) * (MOST / distance2).sqrt();
        }
        self.newest.push_back(frame);
        if learn {
            self.learn(expected);
        }
        self.newest.drain(..self.newest.len().saturating_sub(LONGEST));
        self.look();
    }

    fn learn(&mut self, expected: Vector3<f64>) {
        let settled = self.newest.len().checked_sub(SETTLED + 1).map(|k| self.newest[k]);
        if let Some(distance2) = settled.and_then(|m| m.distance2(expected)) {
            self.scattered = (self.scattered + 1.0).min(MEMORY);
            self.dispersion += (distance2 / 3.0 - self.dispersion) / self.scattered;
        }
        if self.newest.len() > LONGEST
            && let Some(old) = self.newest.pop_front()
        {
            self.filling.0.add(&old);
            self.filling.1 += 1;
            if self.filling.1 == BLOCK {
                self.blocks.push_back(std::mem::take(&mut self.filling).0);
                if self.blocks.len() > BLOCKS {
                    self.blocks.pop_front();
                }
            }
        }
    }

    /// Everything before the newest `n` frames, where that is enough.
    fn sum_before(&self, n: usize) -> Option<SecondMomentScore> {
        let old = self.newest.len().checked_sub(n)?;
        let frames = self.blocks.len() as u32 * BLOCK + self.filling.1 + old as u32;
        (frames >= FEWEST).then(|| {
            let mut sum = self.filling.0;
            self.blocks
                .iter()
                .chain(self.newest.iter().take(old))
                .for_each(|m| sum.add(m));
            sum
        })
    }

    fn before(&self, n: usize) -> Option<Vector3<f64>> {
        self.sum_before(n)?.solved().map(|(mean, _)| mean)
    }

    fn newest(&self, n: usize) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let first = self.newest.len().checked_sub(n)?;
        let mut sum = SecondMomentScore::default();
        self.newest.iter().skip(first).for_each(|m| sum.add(m));
        sum.solved()
    }

    /// Standard deviation of what the blocks' means do beyond their noise.
    fn drift(&self) -> f64 {
        let means: Vec<_> = self.blocks.iter().filter_map(|b| b.solved()).collect();
        if means.len() < DRIFT_BLOCKS {
            return ASSUMED_DRIFT;
        }
        let n = means.len() as f64;
        let middle = means.iter().map(|(m, _)| m).sum::<Vector3<f64>>() / n;
        let squares: f64 = means.iter().map(|(m, _)| (m - middle).norm_squared()).sum();
        let noise: f64 = means.iter().map(|(_, cov)| cov.trace()).sum::<f64>() * self.dispersion.max(1.0) / n;
        (((squares / (n - 1.0) - noise) / 3.0).max(0.0)).sqrt().max(LEAST_DRIFT)
    }

    fn look(&mut self) {
        let dispersion = self.dispersion.max(1.0);
        let drift = Matrix3::identity() * self.drift().powi(2);
        self.seen = WINDOWS.map(|n| {
            let (mean, cov) = self.newest(n)?;
            let cov = cov * dispersion;
            let before = self.sum_before(n).and_then(|m| m.solved());
            let rise = before.map(|(past, past_cov)| (mean - past, cov + past_cov * dispersion + drift));
            Some(Seen {
                level: (mean, cov),
                rise,
            })
        });
    }

    /// How much wider the spot is than expected (trace, σ²), and the surprise of the window and test that show it most: with no
    /// correction for their number, up to ten of which share data.
    pub fn neg_log_p(&self, common: &CommonMode) -> (f64, f64) {
        let mut worst = (0.0, 0.0);
        let unlike = Matrix3::identity() * UNLIKE_OTHERS.powi(2);
        for (seen, common) in self.seen.iter().zip(&common.0) {
            let Some(seen) = seen else { break };
            let level = Some((seen.level.0 - common.level.0, seen.level.1 + common.level.1 + unlike));
            let rise = seen.rise.map(|(rise, cov)| (rise - common.rise.0, cov + common.rise.1));
            for (off, cov) in level.into_iter().chain(rise) {
                let Some(inverse) = cov.try_inverse() else { continue };
                let wider = spread(off, inverse);
                if wider.1 > worst.1 {
                    worst = wider;
                }
            }
        }
        worst
    }
}

impl CommonMode {
    /// Medians over `others`, where there are enough, with their own uncertainty.
    pub fn of<'a>(others: impl Iterator<Item = &'a SecondMomentTest> + Clone) -> Self {
        Self(std::array::from_fn(|k| {
            let seen = || others.clone().filter_map(|b| b.seen[k]);
            Window {
                level: middle(seen().map(|s| s.level.0).collect()),
                rise: middle(seen().filter_map(|s| s.rise).map(|r| r.0).collect()),
            }
        }))
    }
}

/// Component-wise median of three or more, and its variance from their scatter.
fn middle(of: Vec<Vector3<f64>>) -> (Vector3<f64>, Matrix3<f64>) {
    if of.len() < FEWEST_OTHERS {
        return (Vector3::zeros(), Matrix3::zeros());
    }
    let axis = |k: usize| {
        let middle = median(of.iter().map(|m| m[k])).unwrap_or(0.0);
        let scatter = 1.4826 * median(of.iter().map(|m| (m[k] - middle).abs())).unwrap_or(0.0);
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

/// Trace of the moments of a second beam in the direction that explains `off` best, and the surprise of it. Whitened, the
/// directions are the edge of a convex cone: a closed convex curve on the unit sphere, at most 2π long. The largest of them exceeds
/// u with a chance of at most Q(u) + e^(−u²/2) (Rice, 1945, for the upcrossings), below 1.5·e^(−u²/2).
fn spread(off: Vector3<f64>, inverse: Matrix3<f64>) -> (f64, f64) {
    let mut best = (0.0, 0.0);
    for k in 0..DIRECTIONS {
        let (y, x) = (std::f64::consts::PI * k as f64 / DIRECTIONS as f64).sin_cos();
        let v = Vector3::new(x * x, x * y, y * y);
        let (slope, curvature) = (v.dot(&(inverse * off)), v.dot(&(inverse * v)));
        let neg_log_p = 0.5 * slope * slope / curvature - 1.5f64.ln();
        if slope > 0.0 && neg_log_p > best.1 {
            best = (slope / curvature, neg_log_p);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Frames of a beam of SNR 40, moments to 0.07 σ², whose moments are `truth`.
    fn frames(n: usize, truth: [f64; 3], seed: u64) -> Vec<SecondMomentScore> {
        let information = [200.0, 400.0, 200.0];
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..n)
            .map(|_| {
                let score = Vector3::from_fn(|k, _| {
                    let z: f64 = StandardNormal.sample(&mut rng);
                    information[k] * truth[k] + z * f64::sqrt(information[k])
                });
                SecondMomentScore {
                    score,
                    information: Matrix3::from_diagonal(&Vector3::from(information)),
                }
            })
            .collect()
    }

    fn told(frames: &[SecondMomentScore]) -> SecondMomentTest {
        let mut moment_test = SecondMomentTest::default();
        frames.iter().for_each(|m| moment_test.note(m, true));
        moment_test
    }

    #[test]
    fn one_beam_is_no_surprise_whatever_its_shape() {
        let shape = [0.05, -0.02, 0.03];
        let mut most: f64 = 0.0;
        for seed in 0..20 {
            let mut moment_test = SecondMomentTest::default();
            for m in frames(2000, shape, seed) {
                moment_test.note(&m, true);
                most = most.max(moment_test.neg_log_p(&CommonMode::default()).1);
            }
        }
        assert!((5.0..16.0).contains(&most), "{most}");
    }

    #[test]
    fn a_second_beam_that_no_frame_shows_is_found_in_a_second() {
        // Equal beams a σ apart along the diagonal, after five seconds of one.
        for seed in 0..20 {
            let mut moment_test = told(&frames(50, [0.0; 3], seed));
            for m in frames(10, [0.125; 3], 100 + seed) {
                moment_test.note(&m, true);
            }
            let (wider, neg_log_p) = moment_test.neg_log_p(&CommonMode::default());
            assert!(
                neg_log_p > 19.0 && (wider - 0.25).abs() < 0.1,
                "seed {seed}: {neg_log_p}, {wider}"
            );
        }
    }

    #[test]
    fn what_all_spots_show_and_a_single_frame_prove_nothing() {
        let mut moment_test = told(&frames(600, [0.0; 3], 1));
        let smear = Vector3::new(0.2, 0.0, 0.2);
        for m in frames(10, smear.into(), 2) {
            moment_test.note(&m, false);
        }
        assert!(moment_test.neg_log_p(&CommonMode::default()).1 > 20.0);
        let others: Vec<SecondMomentTest> = (10..15)
            .map(|seed| {
                let mut other = told(&frames(600, [0.0; 3], seed));
                frames(10, smear.into(), 100 + seed)
                    .iter()
                    .for_each(|m| other.note(m, false));
                other
            })
            .collect();
        assert!(moment_test.neg_log_p(&CommonMode::of(others.iter())).1 < 10.0);
        let mut moment_test = told(&frames(600, [0.0; 3], 3));
        frames(1, [5.0, 0.0, 5.0], 4)
            .iter()
            .for_each(|m| moment_test.note(m, false));
        assert!(moment_test.neg_log_p(&CommonMode::default()).1 < 15.0);
    }
}
