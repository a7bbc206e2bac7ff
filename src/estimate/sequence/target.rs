//! An emitter that the window follows, and whether it has gone dark.

use crate::estimate::rules::Rules;
use crate::estimate::sequence::straying::Straying;

/// Frames over which a target's mean energy is averaged.
const MANY: f64 = 100.0;
/// Evidence, ln, that a target has gone dark before it is dropped: false once in a million.
const DARK: f64 = 14.0;
/// Evidence, ln, from which one that a single frame has shown is not reported, more by ln n for one of n frames; and most of it that one frame
/// brings: a deep fade is not the end.
const NOT_SEEN: f64 = 5.0;
const OF_A_FRAME: f64 = 4.0;
/// A newcomer below so many standard deviations of its energy may be noise until later frames bring this evidence, ln, that it is there. Until
/// then it is dropped on less evidence, and not reported again: noise that is remembered would be followed as a beam. More keeps noise until it
/// is a track, less drops newcomers who fade.
const FAINT: f64 = 9.0;
const CONFIRMED: f64 = 6.5;
const DARK_NEWCOMER: f64 = 2.5;

/// An emitter that the window follows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target {
    /// Earlier frames do not hold it, s.
    pub born_s: f64,
    /// This frame and later ones do not hold it, s; it is forgotten with the last frame that does.
    pub died_s: f64,
    /// Mean energy of its frames, and their number up to [`MANY`].
    mean_energy: f64,
    frames: f64,
    /// Of one that may be noise: ln of the evidence of later frames that it is there over that it is not.
    confirmation: Option<f64>,
    /// ln of the evidence that it has gone dark over that it has not, never below zero.
    darkness: f64,
    pub straying: Straying,
    /// Of frames that have left the window.
    pub folded: Light,
}

/// What an emitter's light weighs in some frames: Σ a²/var(a), and the number of those that it lights.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Light {
    pub evidence: f64,
    pub lit: f64,
}

impl Light {
    pub fn add(&mut self, other: Self) {
        self.evidence += other.evidence;
        self.lit += other.lit;
    }
}

impl Target {
    pub fn born(born_s: f64) -> Self {
        Self {
            born_s,
            died_s: f64::INFINITY,
            mean_energy: 0.0,
            frames: 0.0,
            confirmation: None,
            darkness: 0.0,
            straying: Straying::default(),
            folded: Light::default(),
        }
    }

    /// Whether a frame may hold it.
    pub fn is_in(&self, time_s: f64) -> bool {
        self.born_s <= time_s && time_s < self.died_s
    }

    /// Whether it has gone dark, or was noise.
    pub fn is_dark(&self, rules: Rules) -> bool {
        self.darkness > if self.is_doubted(rules) { DARK_NEWCOMER } else { DARK }
    }

    fn is_doubted(&self, rules: Rules) -> bool {
        self.confirmation.is_some() && rules.doubt_faint_newcomers
    }

    /// Whether it is still seen, or seen for the first time: what is gone would be followed as a beam until it is dropped.
    pub fn is_seen(&self, rules: Rules) -> bool {
        let is_new = self.frames <= 1.0;
        let is_gone = self.darkness >= NOT_SEEN + self.frames.max(1.0).ln();
        !(is_gone && rules.hide_dark) && (is_new || !self.is_doubted(rules))
    }

    /// Takes the energy that the frame at `time_s` measured, with its variance, at `weight` of an independent draw of the fading. The evidence
    /// is between no light and light that is exponentially distributed about its mean, which no fading exceeds by much in the dark.
    pub fn weigh(&mut self, time_s: f64, energy: f64, variance: f64, weight: f64) {
        let std = variance.sqrt();
        if self.frames == 0.0 && self.born_s == time_s && energy < FAINT * std {
            self.confirmation = Some(0.0);
        }
        if self.frames > 0.0 && self.mean_energy > 0.0 && std.is_finite() {
            let z = energy / std - std / self.mean_energy;
            // e^{z²/2}·Φ(z), by its asymptote where Φ underflows.
            let tail = if z < -6.0 {
                -1.0 / (z * (2.0 * std::f64::consts::PI).sqrt())
            } else {
                (0.5 * z * z).min(600.0).exp() * 0.5 * libm::erfc(-z * std::f64::consts::FRAC_1_SQRT_2)
            };
            let alive = ((2.0 * std::f64::consts::PI).sqrt() * std / self.mean_energy * tail).ln();
            self.darkness = (self.darkness + weight * (-alive).min(OF_A_FRAME)).max(0.0);
            let confirmation = self.confirmation.map(|sum| sum + weight * alive);
            self.confirmation = confirmation.filter(|sum| *sum < CONFIRMED);
        }
        self.frames = (self.frames + 1.0).min(MANY);
        self.mean_energy += (energy - self.mean_energy) / self.frames;
    }
}

#[cfg(test)]
mod tests {
    use super::{Rules, Target};

    /// One born at 0 whose energy is measured as `energies`, with a standard deviation of 1.
    fn target(energies: &[f64]) -> Target {
        let mut target = Target::born(0.0);
        for (time_s, energy) in (0u8..).zip(energies) {
            target.weigh(f64::from(time_s), *energy, 1.0, 1.0);
        }
        target
    }

    #[test]
    fn a_faint_newcomer_who_does_not_come_again_was_noise() {
        assert!(!target(&[7.0, 0.0]).is_dark(Rules::default()));
        assert!(target(&[7.0, 0.0, 0.0]).is_dark(Rules::default()));
        assert!(
            !target(&[7.0, 5.0, 0.0, 0.0]).is_dark(Rules::default()),
            "it came again"
        );
        assert!(
            !target(&[70.0, 0.0, 0.0]).is_dark(Rules::default()),
            "noise is not that bright"
        );
    }

    #[test]
    fn a_faint_newcomer_is_seen_at_once_and_again_when_frames_confirm_it() {
        let is_seen = |energies: &[f64]| target(energies).is_seen(Rules::default());
        assert!(is_seen(&[7.0]) && !is_seen(&[7.0, 2.0]));
        assert!(is_seen(&[7.0, 4.5]), "one frame shows it for certain");
        assert!(
            !is_seen(&[7.0, 3.0]) && is_seen(&[7.0, 3.0, 3.0, 3.0]),
            "several together do"
        );
        assert!(is_seen(&[70.0, 2.0]), "noise is not that bright");
    }

    #[test]
    fn a_deep_fade_hides_nobody_and_who_has_gone_is_dropped() {
        let mut seen = vec![100.0; 50];
        let after = |dark: usize, seen: &mut Vec<f64>| {
            seen.resize(50 + dark, 0.0);
            let target = target(seen);
            (target.is_seen(Rules::default()), target.is_dark(Rules::default()))
        };
        assert_eq!(after(2, &mut seen), (true, false));
        assert_eq!(after(3, &mut seen), (false, false));
        assert_eq!(after(4, &mut seen), (false, true));
    }
}
