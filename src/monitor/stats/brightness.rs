//! Whether a beam is brighter than it was: Student's test of the newest ln energies against their past.

use jiff::Timestamp;

use super::block_history::{BLOCK_FRAMES, BlockHistory, MIN_DRIFT_BLOCKS, Recent};
use super::window_excess::{WINDOWS, WindowExcess, most_significant};

/// Blocks of past before a beam has a history to be compared with: two leave one degree of freedom for its scatter.
const MIN_BLOCKS: usize = 2;
/// Variance of a beam's slow drift in units of a block mean's variance, until blocks show it. Larger delays the first verdict
/// of a beam, smaller takes drift for a second beam. Not measured.
const ASSUMED_DRIFT: f64 = 0.5;
/// A beam whose blocks scatter by this factor more in variance than all beams' do is tested against its own scatter. Smaller lets
/// chance decide with a few blocks, larger holds one user's unsteady light against them. Not measured.
const OWN_SCATTER_RATIO: f64 = 3.0;
/// Smallest standard deviation of an ln energy: what gains and the fit leave however steady the light. Not measured.
const MIN_LN_STD: f64 = 0.05;

/// Standard errors by which frames that are independent may seem to repeat. Smaller delays the alerts of beams that come by chance to look
/// so, larger misses what few frames show of slow fading.
const BY_CHANCE: f64 = 2.0;

/// The light of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// ln of the energy, J.
    pub ln_energy: f64,
    /// ln of the geometric gain, but for a constant.
    pub ln_gain: f64,
}

/// A beam's ln energies. How they follow its distance is not known: a wide beam's light falls with its square, a narrow one's not at all. So
/// energies are compared as at the same gain, and what a loss of gain may be too much for that is no evidence.
#[derive(Clone, Debug, Default)]
pub struct Brightness {
    /// ln energies less the gain, and gains.
    recent: Recent<(Timestamp, f64)>,
    gains: Recent<(Timestamp, f64)>,
    past: BlockHistory<Variance>,
    /// The gain that the past was seen with is not known.
    is_gain_unknown: bool,
}

/// Mean and sum of squared deviations (Welford, 1962), and of squared steps from one value to the next.
#[derive(Clone, Copy, Debug, Default)]
struct Variance {
    n: u32,
    mean: f64,
    gain: f64,
    squares: f64,
    last: f64,
    steps: f64,
}

/// Sum of squared deviations of block means and its degrees of freedom.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scatter {
    pub squares: f64,
    pub freedom: f64,
}

impl Variance {
    fn add(&mut self, x: f64, gain: f64) {
        if self.n > 0 {
            self.steps += (x - self.last).powi(2);
        }
        self.last = x;
        self.n += 1;
        let d = x - self.mean;
        self.mean += d / f64::from(self.n);
        self.squares += d * (x - self.mean);
        self.gain += (gain - self.gain) / f64::from(self.n);
    }
}

impl Scatter {
    fn variance(&self) -> f64 {
        self.squares / self.freedom.max(1.0)
    }
}

impl std::iter::Sum for Scatter {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, s| Self {
            squares: sum.squares + s.squares,
            freedom: sum.freedom + s.freedom,
        })
    }
}

impl Brightness {
    /// A beam known from before a restart by the mean and standard deviation of its ln energy, at the gain that its next frame has.
    pub fn remembered(mean: f64, std: f64) -> Self {
        let squares = f64::from(BLOCK_FRAMES - 1) * std * std;
        let block = Variance {
            n: BLOCK_FRAMES,
            mean,
            gain: 0.0,
            squares,
            last: mean,
            steps: 2.0 * squares,
        };
        Self {
            past: BlockHistory::of(std::iter::repeat_n(block, MIN_DRIFT_BLOCKS)),
            is_gain_unknown: true,
            ..Self::default()
        }
    }

    /// Takes a frame's light. With `learn` the frame that it pushes out of the newest is added to the past.
    pub fn push(&mut self, time: Timestamp, light: Light, learn: bool) {
        let Light { ln_energy, ln_gain } = light;
        if std::mem::take(&mut self.is_gain_unknown) {
            for block in self.past.blocks_mut() {
                block.mean -= ln_gain;
                block.gain = ln_gain;
            }
        }
        let oldest = (self.recent.push((time, ln_energy - ln_gain))).zip(self.gains.push((time, ln_gain)));
        if let Some(((_, at_gain), (_, gain))) = oldest.filter(|_| learn) {
            self.past.push(|block| block.add(at_gain, gain));
        }
    }

    /// Forgets the newest frames, not the past.
    pub fn restart(&mut self) {
        self.recent = Recent::default();
        self.gains = Recent::default();
    }

    /// Newest frames.
    pub fn frames(&self) -> usize {
        self.recent.len()
    }

    /// How many of them are from `time` or later.
    pub fn frames_since(&self, time: Timestamp) -> usize {
        self.recent.count_since(time)
    }

    /// Mean and standard deviation of the past's ln energy.
    pub fn past(&self) -> Option<(f64, f64)> {
        Some((self.past_mean()? + self.past_gain(), self.within().sqrt()))
    }

    /// Rise of the mean ln energy of the shortest window over the past, at the same gain.
    pub fn recent_rise(&self) -> Option<f64> {
        (self.recent.len() >= WINDOWS[0]).then_some(self.recent.mean_of_newest(WINDOWS[0]) - self.past_mean()?)
    }

    /// How the blocks' means scatter.
    pub fn scatter(&self) -> Scatter {
        self.past_mean().map_or(Scatter::default(), |past| Scatter {
            squares: self.past.blocks().map(|b| (b.mean - past).powi(2)).sum(),
            freedom: self.past.len() as f64 - 1.0,
        })
    }

    /// The most significant of all windows. A rise of `allowed` in ln energy is no evidence; `all_beams` is the scatter of every
    /// beam's blocks.
    pub fn most_significant(&self, allowed: f64, all_beams: Scatter) -> WindowExcess {
        most_significant(|n| self.test(n, allowed, all_beams))
    }

    /// Student's test of the mean ln energy of the newest `n` frames against the past. The past's blocks scatter by more than
    /// its frames explain where light drifts slowly: a random effect of variance τ², which no window averages out. The tail
    /// of t falls as (1 + t²/ν)^(−(ν+1)/2), with ν from Satterthwaite (1946): a few blocks of history prove little.
    pub fn test(&self, n: usize, allowed: f64, all_beams: Scatter) -> Option<WindowExcess> {
        if self.recent.len() < n {
            return None;
        }
        let past = self.past_mean()?;
        let blocks = self.past.len() as f64;
        let repeats = self.repeats();
        let frames_freedom = self.past.blocks().map(|b| f64::from(b.n - 1)).sum::<f64>() / repeats;
        let within = repeats * self.within();
        let of_block = within / f64::from(BLOCK_FRAMES);
        let own = self.scatter();
        let scatter = match own.variance() > OWN_SCATTER_RATIO * all_beams.variance() {
            true => own,
            false => all_beams,
        };
        let (drift, drift_freedom) = if scatter.freedom >= MIN_DRIFT_BLOCKS as f64 {
            ((scatter.variance() - of_block).max(0.0), scatter.freedom)
        } else {
            (ASSUMED_DRIFT * of_block, frames_freedom)
        };
        let slow = drift * (1.0 + 1.0 / blocks);
        let fast = within / n as f64 + of_block / blocks;
        let variance = slow + fast;
        let freedom = variance * variance / (slow * slow / drift_freedom + fast * fast / frames_freedom);
        let rise = self.recent.mean_of_newest(n) - past;
        let gained = self.gains.mean_of_newest(n) - self.past_gain();
        let t = (rise + gained.min(0.0) - allowed).max(0.0) / variance.sqrt();
        Some(WindowExcess {
            ratio: (rise + gained).exp(),
            neg_log_p: 0.5 * (freedom + 1.0) * (t * t / freedom).ln_1p(),
        })
    }

    fn past_mean(&self) -> Option<f64> {
        let n = self.past.len();
        (n >= MIN_BLOCKS).then(|| self.past.blocks().map(|b| b.mean).sum::<f64>() / n as f64)
    }

    fn past_gain(&self) -> f64 {
        self.past.blocks().map(|b| b.gain).sum::<f64>() / self.past.len() as f64
    }

    /// Frames that count as one where each repeats much of the one before: (1 + ρ)/(1 − ρ) for a first-order autoregression (Bartlett,
    /// 1935), ρ from the mean squared step over the variance (von Neumann, 1941). What chance makes of independent frames counts as none.
    fn repeats(&self) -> f64 {
        let squares = self.past.blocks().map(|b| b.squares).sum::<f64>();
        let steps = self.past.blocks().map(|b| b.steps).sum::<f64>();
        let correlation = 1.0 - steps / (2.0 * squares);
        match correlation * f64::from(self.past.frames()).sqrt() > BY_CHANCE {
            true => (1.0 + correlation) / (1.0 - correlation),
            false => 1.0,
        }
    }

    /// Variance of ln energies within blocks.
    fn within(&self) -> f64 {
        let freedom = self.past.blocks().map(|b| f64::from(b.n - 1)).sum::<f64>();
        let variance = self.past.blocks().map(|b| b.squares).sum::<f64>() / freedom.max(1.0);
        variance.max(MIN_LN_STD * MIN_LN_STD)
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn fed(brightness: &mut Brightness, frames: usize, ln_energy: impl Fn(usize) -> f64) {
        let first = brightness.frames();
        for k in 0..frames {
            let time = Timestamp::from_millisecond(100 * (first + k) as i64).unwrap();
            let (ln_energy, ln_gain) = (ln_energy(k), 0.0);
            brightness.push(time, Light { ln_energy, ln_gain }, true);
        }
    }

    #[test]
    fn a_beam_without_a_past_is_not_tested() {
        let mut young = Brightness::default();
        // 80 newest frames and one block: one block is no past.
        fed(&mut young, 110, |_| 0.0);
        assert_eq!(young.past(), None);
        assert_eq!(young.test(10, 0.0, Scatter::default()), None);
        fed(&mut young, 30, |_| 0.0);
        assert_eq!(young.past(), Some((0.0, MIN_LN_STD)));
    }

    #[test]
    fn the_t_statistic_by_hand() {
        // Six remembered blocks of equal means, σ = 0.3 within blocks; ten frames at a rise of 1.
        let mut beam = Brightness::remembered(2.0, 0.3);
        fed(&mut beam, 10, |_| 3.0);
        let found = beam.test(10, 0.0, Scatter::default()).unwrap();
        assert!((found.ratio - 1f64.exp()).abs() < 1e-12);
        // No scatter is known: drift ½·0.09/30 = 0.0015, slow = 0.0015·7/6, fast = 0.09/10 + 0.003/6; ν = 6·29 for both.
        let (slow, fast) = (0.0015 * 7.0 / 6.0, 0.009 + 0.0005);
        let variance = slow + fast;
        let freedom = 174.0 * variance * variance / (slow * slow + fast * fast);
        let expected = 0.5 * (freedom + 1.0) * f64::ln_1p(1.0 / variance / freedom);
        assert!((found.neg_log_p / expected - 1.0).abs() < 1e-9, "{found:?} {expected}");
    }

    #[test]
    fn an_allowed_rise_and_a_fall_are_no_evidence() {
        let mut beam = Brightness::remembered(2.0, 0.3);
        fed(&mut beam, 10, |_| 2.29);
        assert_eq!(beam.most_significant(0.3, Scatter::default()).neg_log_p, 0.0);
        let mut beam = Brightness::remembered(2.0, 0.3);
        fed(&mut beam, 10, |_| 0.0);
        assert_eq!(beam.most_significant(0.0, Scatter::default()).neg_log_p, 0.0);
    }

    #[test]
    fn a_beam_that_comes_nearer_or_goes_away_is_no_second_one() {
        // Light that falls with the square of the distance, and light that does not.
        let evidence = |follows: f64, gained: f64, joined: f64| {
            let mut beam = Brightness::default();
            for k in 0..400 {
                let ln_gain = gained * f64::from(k) / 400.0;
                let noise = if k % 2 == 0 { 0.1 } else { -0.1 };
                let ln_energy = follows * ln_gain + noise + if k >= 360 { joined } else { 0.0 };
                let time = Timestamp::from_millisecond(100 * i64::from(k)).unwrap();
                beam.push(time, Light { ln_energy, ln_gain }, true);
            }
            beam.most_significant(0.3, beam.scatter()).neg_log_p
        };
        for (follows, gained) in [(1.0, 2.0), (0.0, 2.0), (1.0, -2.0), (0.0, -2.0)] {
            assert_eq!(evidence(follows, gained, 0.0), 0.0, "{follows} {gained}");
        }
        assert!(evidence(1.0, 2.0, 1.2) > 15.0);
    }

    #[test]
    fn drift_that_all_beams_show_takes_evidence_away() {
        let mut beam = Brightness::remembered(2.0, 0.3);
        fed(&mut beam, 10, |_| 3.0);
        let steady = beam.test(10, 0.0, Scatter::default()).unwrap().neg_log_p;
        let drifting = Scatter {
            squares: 2.5,
            freedom: 10.0,
        };
        assert!(beam.test(10, 0.0, drifting).unwrap().neg_log_p < 0.25 * steady);
    }

    #[test]
    fn light_that_changes_slowly_has_risen_by_chance() {
        // The same rise over light that is new in each frame and over light that is new in every tenth.
        let evidence = |held: usize| {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let light: Vec<f64> = (0..=260 / held).map(|_| rng.random_range(-0.5..0.5)).collect();
            let mut beam = Brightness::default();
            fed(&mut beam, 180, |k| light[k / held]);
            fed(&mut beam, 80, |k| light[(180 + k) / held] + 0.8);
            beam.most_significant(0.3, Scatter::default()).neg_log_p
        };
        let (white, slow) = (evidence(1), evidence(10));
        assert!(white > 30.0 && slow < 10.0, "{white} {slow}");
    }

    #[test]
    fn welfords_sums_are_mean_and_variance() {
        let mut v = Variance::default();
        [1.0, 2.0, 6.0].into_iter().for_each(|x| v.add(x, 2.0));
        assert_eq!((v.n, v.mean, v.squares, v.gain), (3, 3.0, 14.0, 2.0));
    }
}
