//! What a known light is like: the range of its energy and scintillation, its place and how far it moves, learned from its track and
//! then held against it.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// Frames of a block, of which each gives a mean and a variance.
const BLOCK_FRAMES: usize = 30;
/// Blocks from which there is a range to hold a light to, and with which it is complete: 12 s and two minutes at 10 frames/s. Fewer
/// begin sooner and know the range less well; more learn a stranger's arrival for longer.
const BLOCKS: [u32; 2] = [4, 40];
/// Windows of newest frames that are tested: a large change is found within one second, a small one within sixteen.
const WINDOWS: [usize; 4] = [10, 20, 80, 160];
/// Smallest standard deviation of ln energy, as for users: what gains and the fit leave however steady the light.
const MIN_LN_STD: f64 = 0.05;
/// Factor by which the variance of ln energies may leave its range: the blocks of a steady light are few. Larger hides a beam that
/// takes a lamp's place, smaller takes a change of the air for one. Not tuned.
const VARIANCE_RATIO: f64 = 1.5;
/// Share of a window's frames that count as independent: scintillation and flicker last longer than a frame. Assumed.
const INDEPENDENT: f64 = 0.5;
/// What a light may leave its learned place by: half of its movement again, and a share of a metre for what moves the platform.
const MOVES: (f64, f64) = (1.5, 0.3);

/// What a light's track has shown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Learned {
    /// Mean place, m.
    pub x_m: f64,
    pub y_m: f64,
    /// Farthest that it was from there, m: more than some decimetres is a light that moves.
    pub moves_m: f64,
    /// Smallest and largest mean energy of three seconds' frames (30), J.
    pub energy_j: [f64; 2],
    /// Smallest and largest standard deviation of ln energy over as many frames: its scintillation.
    pub ln_energy_std: [f64; 2],
    /// Mean ln energy, ln J.
    pub ln_energy: f64,
    /// Variance of ln energy within blocks, and of the blocks' means beyond it.
    pub variance_within: f64,
    pub variance_between: f64,
    /// Frames that it is of; it is complete with 1200.
    pub frames: u64,
    /// When the last of them was taken.
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
}

/// A light's newest frames, and what is learned of it.
#[derive(Clone, Debug, Default)]
pub struct LightRange {
    recent: VecDeque<f64>,
    filling: Vec<f64>,
    means: Vec<f64>,
    variances: Vec<f64>,
    places: u64,
    mean_place: Vector2<f64>,
    moves_m: f64,
    learned: Option<Learned>,
}

/// How a light differs from what was learned; each `neg_log_p` s is exceeded with a probability of about e⁻ˢ by a light that stays what
/// it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Change {
    /// Mean energy over the nearest of the range.
    pub energy_ratio: f64,
    pub energy: f64,
    /// Variance of ln energy over the nearest of the range.
    pub scintillation_ratio: f64,
    pub scintillation: f64,
}

impl LightRange {
    pub fn remembered(learned: Learned) -> Self {
        Self {
            learned: Some(learned),
            ..Self::default()
        }
    }

    pub fn learned(&self) -> Option<&Learned> {
        self.learned.as_ref()
    }

    /// Whether nothing is added to the range any more.
    pub fn is_complete(&self) -> bool {
        let frames = self.learned.as_ref().map_or(0, |l| l.frames);
        frames >= u64::from(BLOCKS[1]) * BLOCK_FRAMES as u64
    }

    /// Takes a frame: ln energy where all of the light is seen, and the place. With `learn` it adds to the range. Gives whether the
    /// range has grown by a block.
    pub fn push(&mut self, now: Timestamp, ln_energy: Option<f64>, place: Vector2<f64>, learn: bool) -> bool {
        if let Some(ln_energy) = ln_energy {
            self.recent.push_back(ln_energy);
            if self.recent.len() > WINDOWS[WINDOWS.len() - 1] {
                self.recent.pop_front();
            }
        }
        if !learn || self.is_complete() {
            return false;
        }
        self.places += 1;
        self.mean_place += (place - self.mean_place) / self.places as f64;
        // A mean of few frames is itself off.
        if self.places > BLOCK_FRAMES as u64 {
            self.moves_m = self.moves_m.max((place - self.mean_place).norm());
        }
        self.filling.extend(ln_energy);
        if self.filling.len() < BLOCK_FRAMES {
            return false;
        }
        let (mean, variance) = moments(self.filling.drain(..));
        self.means.push(mean);
        self.variances.push(variance);
        self.summarise(now)
    }

    fn summarise(&mut self, now: Timestamp) -> bool {
        let blocks = self.means.len();
        // After a restart a range that was begun stays in force until the new one has as many blocks.
        let before = self.learned.as_ref().map_or(0, |l| l.frames / BLOCK_FRAMES as u64);
        if blocks < BLOCKS[0] as usize || (blocks as u64) < before {
            return false;
        }
        let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
        let most = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (ln_energy, between) = moments(self.means.iter().copied());
        let within = (self.variances.iter().sum::<f64>() / blocks as f64).max(MIN_LN_STD * MIN_LN_STD);
        self.learned = Some(Learned {
            x_m: self.mean_place.x,
            y_m: self.mean_place.y,
            moves_m: self.moves_m,
            energy_j: [least(&self.means).exp(), most(&self.means).exp()],
            ln_energy_std: [least(&self.variances).sqrt(), most(&self.variances).sqrt()],
            ln_energy,
            variance_within: within,
            variance_between: (between - within / BLOCK_FRAMES as f64).max(0.0),
            frames: (blocks * BLOCK_FRAMES) as u64,
            at: now,
        });
        true
    }

    /// Mean ln energy of the newest second's frames over what was learned: what lights have in common is the air.
    pub fn offset(&self) -> Option<f64> {
        let n = WINDOWS[0];
        let learned = self.learned.as_ref().filter(|_| self.recent.len() >= n)?;
        Some(self.recent.iter().rev().take(n).sum::<f64>() / n as f64 - learned.ln_energy)
    }

    /// The most significant window. A change of the energy by the factor `tolerated` either way is none; `common` is the offset of
    /// other lights.
    pub fn change(&self, tolerated: f64, common: f64) -> Change {
        let mut change = Change {
            energy_ratio: 1.0,
            scintillation_ratio: 1.0,
            ..Change::default()
        };
        let Some(learned) = &self.learned else { return change };
        let newest: Vec<f64> = self.recent.iter().rev().copied().collect();
        for window in WINDOWS.into_iter().filter_map(|n| newest.get(..n)) {
            let n = window.len();
            let (mean, _) = moments(window.iter().copied());
            let (off, energy) = energy_change(learned, mean - common, n, tolerated.ln());
            if energy >= change.energy {
                (change.energy_ratio, change.energy) = (off.exp(), energy);
            }
            // Ten frames show a variance to half of it only.
            if n == WINDOWS[0] {
                continue;
            }
            let (ratio, scintillation) = variance_change(learned, window);
            if scintillation >= change.scintillation {
                (change.scintillation_ratio, change.scintillation) = (ratio, scintillation);
            }
        }
        change
    }

    /// How far from its learned place the light may be, m, and where that is.
    pub fn place(&self) -> Option<(Vector2<f64>, f64)> {
        let learned = self.learned.as_ref()?;
        let (share, slack_m) = MOVES;
        Some((
            Vector2::new(learned.x_m, learned.y_m),
            share * learned.moves_m + slack_m,
        ))
    }
}

/// Mean and variance.
fn moments(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (mut n, mut mean, mut squares) = (0.0, 0.0, 0.0);
    for x in values {
        n += 1.0;
        let d = x - mean;
        mean += d / n;
        squares += d * (x - mean);
    }
    (mean, squares / (n - 1.0f64).max(1.0))
}

/// Student's test of a window's mean against the nearest end of the range, as for a user's brightness, to both sides: gives how far
/// outside of it the mean is, and −ln p. The ends are those of blocks' means, less what the noise of these adds to them.
fn energy_change(learned: &Learned, mean: f64, n: usize, allowed: f64) -> (f64, f64) {
    let noise = learned.variance_within / BLOCK_FRAMES as f64;
    let own = (learned.variance_between / (learned.variance_between + noise)).sqrt();
    let [low, high] = learned
        .energy_j
        .map(|end| learned.ln_energy + own * (end.ln() - learned.ln_energy));
    let off = if mean > high {
        mean - high
    } else {
        (mean - low).min(0.0)
    };
    let blocks = learned.frames as f64 / BLOCK_FRAMES as f64;
    let slow = learned.variance_between * (1.0 + 1.0 / blocks);
    let fast = learned.variance_within * (1.0 / (INDEPENDENT * n as f64) + 1.0 / learned.frames as f64);
    let variance = slow + fast;
    let frames_freedom = learned.frames as f64 - blocks;
    // Satterthwaite (1946).
    let freedom = variance * variance / (slow * slow / (blocks - 1.0).max(1.0) + fast * fast / frames_freedom);
    let t = (off.abs() - allowed).max(0.0) / variance.sqrt();
    (off, 0.5 * (freedom + 1.0) * (t * t / freedom).ln_1p())
}

/// Chernoff's bound on a variance of ν degrees of freedom: P(ratio beyond r) ≤ exp(−ν/2·(r − 1 − ln r)). The ends of the range are
/// those of blocks' variances, less what the noise of these adds to them; the window's is that within its own blocks, since what
/// changes more slowly is in neither.
fn variance_change(learned: &Learned, window: &[f64]) -> (f64, f64) {
    let blocks = window.chunks(BLOCK_FRAMES);
    let freedom = (window.len() - blocks.len()) as f64;
    let squares = blocks.map(|block| moments(block.iter().copied()).1 * (block.len() - 1) as f64);
    let variance = squares.sum::<f64>() / freedom;
    let floor = |v: f64| v.max(MIN_LN_STD * MIN_LN_STD);
    let middle = floor(learned.variance_within);
    let noise = extreme_of_variances(learned.frames as f64 / BLOCK_FRAMES as f64);
    let [low, high] = learned.ln_energy_std.map(|std| {
        let off = (floor(std * std) / middle).ln();
        let own = (off * off - noise * noise).max(0.0).sqrt();
        middle * own.copysign(off).exp()
    });
    let variance = floor(variance);
    let (ratio, beyond) = if variance > high {
        (variance / high, variance / high / VARIANCE_RATIO)
    } else {
        ((variance / low).min(1.0), variance / low * VARIANCE_RATIO)
    };
    let is_beyond = if ratio > 1.0 { beyond > 1.0 } else { beyond < 1.0 };
    match is_beyond {
        true => (ratio, 0.5 * INDEPENDENT * freedom * (beyond - 1.0 - beyond.ln())),
        false => (ratio, 0.0),
    }
}

/// How far the largest (or smallest) of so many blocks' ln variances is from the middle where the light is steady: the mean of
/// Gumbel's distribution, the limit for normal deviates; 0.1 of their standard deviation too large from 4 blocks to 40.
fn extreme_of_variances(blocks: f64) -> f64 {
    const EULER: f64 = 0.577_215_664_901_532_9;
    let std = (2.0 / (INDEPENDENT * BLOCK_FRAMES as f64 - 1.0)).sqrt();
    let log = blocks.max(2.0).ln();
    let scale = 1.0 / (2.0 * log).sqrt();
    std * (1.0 / scale + scale * (EULER - 0.5 * (4.0 * std::f64::consts::PI * log).ln()))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Threshold of one test of twenty lights at 10 frames/s and one false alert a month.
    const THRESHOLD: f64 = 22.0;

    struct Lamp {
        range: LightRange,
        rng: ChaCha8Rng,
    }

    impl Lamp {
        fn new(std: f64, seed: u64) -> Self {
            let mut lamp = Self {
                range: LightRange::default(),
                rng: ChaCha8Rng::seed_from_u64(seed),
            };
            (0..1200).for_each(|_| lamp.shine(0.0, std));
            assert!(lamp.range.is_complete());
            lamp
        }

        fn shine(&mut self, ln_energy: f64, std: f64) {
            let z: f64 = StandardNormal.sample(&mut self.rng);
            let place = Vector2::new(0.05 * z, 0.0);
            self.range
                .push(Timestamp::UNIX_EPOCH, Some(ln_energy + std * z), place, true);
        }

        /// Frames until the change is above the threshold.
        fn frames_until_found(&mut self, ln_energy: f64, std: f64) -> Option<u32> {
            (1..=300).find(|_| {
                self.shine(ln_energy, std);
                let change = self.range.change(1.35, 0.0);
                change.energy.max(change.scintillation) > THRESHOLD
            })
        }
    }

    #[test]
    fn a_light_that_stays_what_it_is_has_not_changed() {
        for (seed, std) in [(1, 0.01), (2, 0.1), (3, 0.3)] {
            let mut lamp = Lamp::new(std, seed);
            let mut most: f64 = 0.0;
            for _ in 0..20_000 {
                lamp.shine(0.0, std);
                let change = lamp.range.change(1.35, 0.0);
                most = most.max(change.energy).max(change.scintillation);
            }
            assert!(most < 12.0, "{std}: {most}");
        }
    }

    #[test]
    fn twice_or_half_of_the_light_is_found_in_seconds() {
        for (ln_energy, std, frames) in [(0.69, 0.05, 10), (-0.69, 0.05, 10), (0.69, 0.3, 160), (-0.69, 0.3, 160)] {
            let found = Lamp::new(std, 4).frames_until_found(ln_energy, std);
            assert!(found.is_some_and(|f| f <= frames), "{ln_energy} {std}: {found:?}");
        }
    }

    #[test]
    fn a_beam_in_the_place_of_a_lamp_and_a_lamp_in_that_of_a_beam_are_found() {
        for (before, after) in [(0.05, 0.3), (0.3, 0.03)] {
            let found = Lamp::new(before, 5).frames_until_found(0.0, after);
            assert!(found.is_some_and(|f| f <= 80), "{before} {after}: {found:?}");
        }
        assert_eq!(Lamp::new(0.1, 6).frames_until_found(0.0, 0.12), None);
    }

    #[test]
    fn what_is_learned_is_the_range_the_place_and_how_far_it_moves() {
        let mut range = LightRange::default();
        for k in 0..1200 {
            let swing = 0.8 * (0.3 * f64::from(k)).sin();
            let ln_energy = if k < 600 { 0.0 } else { 0.2 };
            range.push(
                Timestamp::UNIX_EPOCH,
                Some(ln_energy),
                Vector2::new(5.0 + swing, 2.0),
                true,
            );
        }
        let learned = range.learned().unwrap();
        assert!(
            (learned.x_m - 5.0).abs() < 0.05 && (learned.moves_m - 0.8).abs() < 0.1,
            "{learned:?}"
        );
        assert!((learned.energy_j[1] / learned.energy_j[0] - 0.2f64.exp()).abs() < 1e-9);
        let (place, reach_m) = range.place().unwrap();
        assert!((place.x - 5.0).abs() < 0.05 && (reach_m - 1.5).abs() < 0.2);
        let mut later = LightRange::remembered(learned.clone());
        assert!(later.is_complete() && !later.push(Timestamp::UNIX_EPOCH, Some(9.0), place, true));
    }
}
