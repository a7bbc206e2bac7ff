use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::monitor::stats::second_moment::{CommonMode, SecondMomentTest};
use crate::monitor::stats::step_change::{StepDetector, StepEvidence};
use crate::monitor::track::detection::Detection;
use crate::monitor::track::kalman::mahalanobis2;

use crate::claims::seconds;
use crate::estimate::Flags;

/// Newest frames that a test looks at.
const WINDOWS: [usize; 4] = [10, 20, 40, 80];
const LONGEST: usize = WINDOWS[WINDOWS.len() - 1];
/// Frames since a step that a test looks at at least.
const FEWEST_AFTER: usize = 3;
/// Frames of a block of history, and blocks kept: two minutes at 10 frames/s.
const BLOCK: u32 = 30;
const BLOCKS: usize = 40;
/// Blocks before a beam has a history to be held against.
const FEWEST_BLOCKS: usize = 2;
/// Blocks from which the slow drift of a beam's energy is known, and its variance in units of a block mean's until then.
const DRIFT_BLOCKS: usize = 6;
const ASSUMED_DRIFT: f64 = 0.5;
/// A beam whose blocks scatter by this factor more in variance than all users' do is judged by its own.
const UNLIKE_DRIFT: f64 = 3.0;
/// What ln energies are not known better than.
const ENERGY_FLOOR: f64 = 0.05;
/// Accelerations of honest users, r.m.s., m/s²: half a g is a hard brake. At 10 frames/s that moves a second difference by
/// 5 cm, and two beams a metre apart by four times as much; at 1 frame/s users' own motion hides both.
const ACCELERATION: f64 = 5.0;
/// One frame counts for so much at most: a sharp turn is one event.
const MOST_UNREST: f64 = 8.0;
/// Honest unrest against its own past, and against the other users' median.
const HONEST_UNREST: f64 = 1.5;
const UNLIKE_OTHERS: f64 = 4.0;
/// Squared sums of second differences of white noise scatter as if only this share of them were independent:
/// 1/(1 + 2(ρ₁² + ρ₂²)), ρ₁ = −2/3, ρ₂ = 1/6.
const INDEPENDENT: f64 = 0.514;

/// Whether what looks like one beam may be two: how bright the spot is against its own past, how it jumps about and how wide it
/// is. Two beams too near to be told apart show one spot at their centre of light; they fade independently, so the spot is
/// brighter than before and wanders between the two from frame to frame; and it is spread along the line between them.
#[derive(Clone, Debug, Default)]
pub struct CoLocationTest {
    /// With the time of each.
    energies: VecDeque<(Timestamp, f64)>,
    filling: Block,
    blocks: VecDeque<Block>,
    /// Each with the time of the first of its three positions.
    jitter: VecDeque<(Timestamp, f64)>,
    /// Mean unrest before the newest frames, and how many it is of.
    rest: f64,
    rested: u32,
    last: VecDeque<(Timestamp, Vector2<f64>, Matrix2<f64>)>,
    pub steps: StepDetector,
    pub moment_test: SecondMomentTest,
}

#[derive(Clone, Copy, Debug, Default)]
struct Block {
    n: u32,
    mean: f64,
    /// Sum of squared deviations (Welford, 1962).
    squares: f64,
}

/// A second difference of positions.
#[derive(Clone, Copy, Debug)]
pub struct SecondDifference {
    since: Timestamp,
    pub by: Vector2<f64>,
    cov: Matrix2<f64>,
}

impl SecondDifference {
    pub fn less(self, common: Vector2<f64>) -> Self {
        Self {
            by: self.by - common,
            ..self
        }
    }
}

/// Sum of squared deviations and its degrees of freedom.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scatter {
    pub squares: f64,
    pub freedom: f64,
}

/// The users beside the one at hand: what befalls everybody is nobody's second beam.
#[derive(Clone, Copy, Debug, Default)]
pub struct OtherBeams {
    /// Medians over the others of the rise in ln energy and of the unrest, where there are enough.
    pub rise: Option<f64>,
    pub jitter: Option<f64>,
    pub moments: CommonMode,
    /// Scatter of everybody's blocks.
    pub scatter: Scatter,
}

/// What speaks for a second beam in a spot. Each surprise s has a chance of at most e⁻ˢ with one beam.
#[derive(Clone, Copy, Debug, Default)]
pub struct CoLocationEvidence {
    /// Mean energy of the newest frames over the past.
    pub brighter: f64,
    pub energy_neg_log_p: f64,
    /// Frame-to-frame unrest over what is expected.
    pub jitter_ratio: f64,
    pub jitter_neg_log_p: f64,
    pub stepped: StepEvidence,
    /// Of energy and unrest since the step.
    pub energy_after: f64,
    pub jitter_after: f64,
    /// Second moment beyond one spot's, σ².
    pub wider: f64,
    pub width_neg_log_p: f64,
}

impl CoLocationEvidence {
    /// All at once: energies, positions and shapes are independent, and several sums of them are asked, each with its share of the
    /// chance of a false alert. Two beams on top of each other have the shape of one; who was there from the start made no step.
    pub fn neg_log_p(&self) -> f64 {
        let (energy, jitter, width) = (self.energy_neg_log_p, self.jitter_neg_log_p, self.width_neg_log_p);
        let (step, brighter, jitter_ratio) = (self.stepped.neg_log_p, self.energy_after, self.jitter_after);
        let sums = [
            (0.6, together(&[energy, jitter])),
            (0.05, together(&[energy, jitter, width])),
            (0.25, together(&[step, brighter])),
            (0.05, together(&[step, brighter, width])),
            (0.05, together(&[step, brighter, jitter_ratio, width])),
        ];
        sums.into_iter()
            .fold(0.0, |most, (share, sum)| most.max(sum + f64::ln(share)))
    }
}

/// The surprise of the sum of k independent ones, each with P(S > s) ≤ e⁻ˢ: P(ΣS > s) ≤ e⁻ˢ·Σ sʲ/j! over j < k (Erlang).
fn together(of: &[f64]) -> f64 {
    let sum: f64 = of.iter().sum();
    let (mut term, mut series) = (1.0, 0.0);
    for j in 1..=of.len() {
        series += term;
        term *= sum / j as f64;
    }
    sum - series.ln()
}

impl Scatter {
    fn variance(&self) -> f64 {
        self.squares / self.freedom.max(1.0)
    }
}

impl Block {
    fn add(&mut self, x: f64) {
        self.n += 1;
        let d = x - self.mean;
        self.mean += d / f64::from(self.n);
        self.squares += d * (x - self.mean);
    }
}

impl CoLocationTest {
    /// A beam known from before a restart by the mean and standard deviation of its ln energy.
    pub fn remembering(mean: f64, std: f64) -> Self {
        let block = Block {
            n: BLOCK,
            mean,
            squares: f64::from(BLOCK - 1) * std * std,
        };
        Self {
            blocks: std::iter::repeat_n(block, DRIFT_BLOCKS).collect(),
            ..Self::default()
        }
    }

    /// Mean and standard deviation of the past's ln energy.
    pub fn past_energy(&self) -> Option<(f64, f64)> {
        Some((self.past()?, self.within().sqrt()))
    }

    /// Whether enough frames have been seen to say that there is no second beam.
    pub fn is_judged(&self) -> bool {
        self.energies.len() >= WINDOWS[2]
    }

    /// Variance of ln energies within blocks.
    fn within(&self) -> f64 {
        let freedom = self.blocks.iter().map(|b| f64::from(b.n - 1)).sum::<f64>();
        let variance = self.blocks.iter().map(|b| b.squares).sum::<f64>() / freedom.max(1.0);
        variance.max(ENERGY_FLOOR * ENERGY_FLOOR)
    }

    /// Second difference of the newest three positions and its covariance, where they are from frames in a row.
    pub fn jump(&mut self, time: Timestamp, detection: &Detection) -> Option<SecondDifference> {
        self.last.push_back((time, detection.position, detection.cov));
        if self.last.len() > 3 {
            self.last.pop_front();
        }
        let (&(t0, p0, c0), &(t1, p1, c1), &(t2, p2, c2)) = (self.last.front()?, self.last.get(1)?, self.last.get(2)?);
        let (first, second) = (seconds(t0, t1), seconds(t1, t2));
        let even = first > 0.0 && (second / first - 1.0).abs() < 0.2 && second < 0.5;
        let motion = Matrix2::identity() * (ACCELERATION * first * second).powi(2);
        even.then(|| SecondDifference {
            since: t0,
            by: p2 - p1 * 2.0 + p0,
            cov: c2 + c1 * 4.0 + c0 + motion,
        })
    }

    /// Frames in which the spot is explained otherwise are no evidence.
    pub fn pause(&mut self) {
        self.last.clear();
    }

    /// Takes a frame: the spot's energy, and its jump less what all beams have in common. `learn` adds what grows old to the past.
    pub fn note(&mut self, time: Timestamp, detection: &Detection, jump: Option<SecondDifference>, learn: bool) {
        let spoilt = Flags::SATURATED | Flags::MASKED | Flags::NEAR_EDGE | Flags::OUT_OF_TIME;
        if detection.energy_j > 0.0 && !detection.flags.intersects(spoilt) {
            self.moment_test.note(&detection.moments, learn);
            self.energies.push_back((time, detection.energy_j.ln()));
            if self.energies.len() > LONGEST
                && let Some((_, old)) = self.energies.pop_front()
                && learn
            {
                self.filling.add(old);
                if self.filling.n == BLOCK {
                    self.blocks.push_back(std::mem::take(&mut self.filling));
                    if self.blocks.len() > BLOCKS {
                        self.blocks.pop_front();
                    }
                }
            }
        }
        if let Some(SecondDifference { since, by, cov }) = jump {
            self.jitter
                .push_back((since, (0.5 * mahalanobis2(by, cov)).min(MOST_UNREST)));
            if self.jitter.len() > LONGEST
                && let Some((_, old)) = self.jitter.pop_front()
                && learn
            {
                self.rested = (self.rested + 1).min(BLOCK * BLOCKS as u32);
                self.rest += (old - self.rest) / f64::from(self.rested);
            }
        }
    }

    /// How the blocks' means scatter.
    pub fn scatter(&self) -> Scatter {
        self.past().map_or(Scatter::default(), |past| Scatter {
            squares: self.blocks.iter().map(|b| (b.mean - past).powi(2)).sum(),
            freedom: self.blocks.len() as f64 - 1.0,
        })
    }

    /// Mean unrest of the newest frames, once there are enough.
    pub fn recent_jitter(&self) -> Option<f64> {
        (self.jitter.len() >= WINDOWS[1]).then(|| newest(&self.jitter, WINDOWS[1]))
    }

    /// Rise of the mean ln energy over the past.
    pub fn recent_rise(&self) -> Option<f64> {
        (self.energies.len() >= WINDOWS[0]).then_some(newest(&self.energies, WINDOWS[0]) - self.past()?)
    }

    fn past(&self) -> Option<f64> {
        let n = self.blocks.len();
        (n >= FEWEST_BLOCKS).then(|| self.blocks.iter().map(|b| b.mean).sum::<f64>() / n as f64)
    }

    /// A beam may honestly grow brighter by the factor `brightening`: it is pointed a little better.
    pub fn evaluate(&self, brightening: f64, other_beams: &OtherBeams) -> CoLocationEvidence {
        let mut worst = CoLocationEvidence::default();
        let honest = brightening.ln() + other_beams.rise.unwrap_or(0.0).max(0.0);
        for n in WINDOWS {
            if let Some((brighter, s)) = self.energy_neg_log_p(n, honest, other_beams.scatter)
                && s >= worst.energy_neg_log_p
            {
                (worst.brighter, worst.energy_neg_log_p) = (brighter, s);
            }
            if let Some((jitter_ratio, s)) = self.jitter_neg_log_p(n, other_beams.jitter)
                && s >= worst.jitter_neg_log_p
            {
                (worst.jitter_ratio, worst.jitter_neg_log_p) = (jitter_ratio, s);
            }
        }
        worst.stepped = self.steps.most().unwrap_or_default();
        if let Some(since) = worst.stepped.since {
            let energy =
                after(&self.energies, since).and_then(|n| self.energy_neg_log_p(n, honest, other_beams.scatter));
            let jitter = after(&self.jitter, since).and_then(|n| self.jitter_neg_log_p(n, other_beams.jitter));
            worst.energy_after = energy.map_or(0.0, |(_, s)| s);
            worst.jitter_after = jitter.map_or(0.0, |(_, s)| s);
        }
        (worst.wider, worst.width_neg_log_p) = self.moment_test.neg_log_p(&other_beams.moments);
        worst
    }

    /// Student's test of the newest mean ln energy against the past, `honest` rise allowed. The past's blocks scatter by more
    /// than its frames explain where light drifts slowly: a random effect of variance τ², which no window averages out. The
    /// tail of t falls as (1 + t²/ν)^(−(ν+1)/2), with ν from Satterthwaite (1946): a few blocks of history prove little.
    fn energy_neg_log_p(&self, n: usize, honest: f64, other_beams: Scatter) -> Option<(f64, f64)> {
        if self.energies.len() < n {
            return None;
        }
        let past = self.past()?;
        let blocks = self.blocks.len() as f64;
        let frames_freedom = self.blocks.iter().map(|b| f64::from(b.n - 1)).sum::<f64>();
        let within = self.within();
        let of_block = within / f64::from(BLOCK);
        let own = self.scatter();
        let scatter = match own.variance() > UNLIKE_DRIFT * other_beams.variance() {
            true => own,
            false => other_beams,
        };
        let (drift, drift_freedom) = if scatter.freedom >= DRIFT_BLOCKS as f64 {
            ((scatter.variance() - of_block).max(0.0), scatter.freedom)
        } else {
            (ASSUMED_DRIFT * of_block, frames_freedom)
        };
        let slow = drift * (1.0 + 1.0 / blocks);
        let fast = within / n as f64 + of_block / blocks;
        let variance = slow + fast;
        let freedom = variance * variance / (slow * slow / drift_freedom + fast * fast / frames_freedom);
        let rise = newest(&self.energies, n) - past;
        let t = (rise - honest).max(0.0) / variance.sqrt();
        Some((rise.exp(), 0.5 * (freedom + 1.0) * (t * t / freedom).ln_1p()))
    }

    /// Chernoff's bound on the mean of k independent χ² of two degrees halved: P(mean ≥ r) ≤ exp(−k(r − 1 − ln r)).
    fn jitter_neg_log_p(&self, n: usize, others: Option<f64>) -> Option<(f64, f64)> {
        if self.jitter.len() < n {
            return None;
        }
        let mean = newest(&self.jitter, n);
        let own = (self.rested >= BLOCK * FEWEST_BLOCKS as u32).then(|| HONEST_UNREST * self.rest.max(0.5));
        let theirs = others.map(|o| UNLIKE_OTHERS * o.max(0.5));
        // What makes everybody restless is nobody's second beam.
        let own = own.map(|own| own.max(HONEST_UNREST * others.unwrap_or(0.0)));
        let expected = match (own, theirs) {
            (Some(a), Some(b)) => a.min(b),
            (one, other) => one.or(other)?,
        };
        let r = mean / expected;
        let s = if r > 1.0 {
            INDEPENDENT * n as f64 * (r - 1.0 - r.ln())
        } else {
            0.0
        };
        Some((r, s))
    }
}

/// Mean of the newest `n`.
fn newest(values: &VecDeque<(Timestamp, f64)>, n: usize) -> f64 {
    values.iter().rev().take(n).map(|(_, v)| v).sum::<f64>() / n as f64
}

/// How many there are from `since` on, where there are enough.
fn after(values: &VecDeque<(Timestamp, f64)>, since: Timestamp) -> Option<usize> {
    let n = values.iter().rev().take_while(|(t, _)| *t >= since).count();
    (n >= FEWEST_AFTER).then_some(n)
}
