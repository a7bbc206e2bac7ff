//! Whether one spot is two beams: brightness, jitter, a step aside and width, combined into one −ln p.

use super::brightness::{Brightness, Scatter};
use super::gaussian::neg_log_p_of_sum;
use super::jitter::Jitter;
use super::second_moment::{CommonMode, SecondMomentTest};
use super::step_change::{StepDetector, StepEvidence};
use super::widening::Widening;
use super::window_excess::{WINDOWS, WindowExcess, of_frames};

/// What is remembered of one spot. Two beams too near to be resolved show one spot at their centre of light; they fade
/// independently, so that the spot is brighter than before and wanders between the two from frame to frame; and it is
/// spread along the line between them.
#[derive(Clone, Debug, Default)]
pub struct CoLocationTest {
    pub brightness: Brightness,
    pub jitter: Jitter,
    pub steps: StepDetector,
    pub second_moment: SecondMomentTest,
}

/// The other beams: what all of them show is no evidence of a second one.
#[derive(Clone, Copy, Debug, Default)]
pub struct OtherBeams {
    /// Median over the others of the rise in ln energy and of the jitter, where there are enough.
    pub rise: Option<f64>,
    pub jitter: Option<f64>,
    pub second_moment: CommonMode,
    /// Scatter of all beams' energy blocks.
    pub scatter: Scatter,
}

/// Evidence of a second beam in a spot. Each `neg_log_p` s is exceeded with a probability of at most e⁻ˢ by one beam.
#[derive(Clone, Copy, Debug, Default)]
pub struct CoLocationEvidence {
    /// Mean energy of the newest frames over the past.
    pub energy: WindowExcess,
    /// Jitter from frame to frame over what is expected.
    pub jitter: WindowExcess,
    pub step: StepEvidence,
    /// Energy and jitter since the step.
    pub energy_since: WindowExcess,
    pub jitter_since: WindowExcess,
    /// Second moments beyond one spot's.
    pub width: Widening,
}

impl CoLocationEvidence {
    /// All together. Energies, positions and shapes are independent; several of their sums are tested, each with its share of the
    /// chance of a false alert. Two beams on top of each other have the shape of one; one that was there from the start made
    /// no step.
    pub fn neg_log_p(&self) -> f64 {
        let (energy, jitter, width) = (self.energy.neg_log_p, self.jitter.neg_log_p, self.width.neg_log_p);
        let step = self.step.neg_log_p;
        let (energy_since, jitter_since) = (self.energy_since.neg_log_p, self.jitter_since.neg_log_p);
        let sums = [
            (0.6, neg_log_p_of_sum(&[energy, jitter])),
            (0.05, neg_log_p_of_sum(&[energy, jitter, width])),
            (0.25, neg_log_p_of_sum(&[step, energy_since])),
            (0.05, neg_log_p_of_sum(&[step, energy_since, width])),
            (0.05, neg_log_p_of_sum(&[step, energy_since, jitter_since, width])),
        ];
        sums.into_iter()
            .fold(0.0, |most, (share, sum)| most.max(sum + f64::ln(share)))
    }
}

impl CoLocationTest {
    /// A beam known from before a restart by the mean and standard deviation of its ln energy.
    pub fn remembered(mean: f64, std: f64) -> Self {
        Self {
            brightness: Brightness::remembered(mean, std),
            ..Self::default()
        }
    }

    /// Forgets the newest frames, which show another's light, not the past.
    pub fn restart(&mut self) {
        self.brightness.restart();
        self.jitter.restart();
        self.steps.restart();
        self.second_moment.restart();
    }

    /// Whether enough frames have been seen to say that there is no second beam.
    pub fn has_verdict(&self) -> bool {
        self.brightness.frames() >= WINDOWS[2]
    }

    /// A beam may honestly become brighter by the factor `brightening`: it is pointed a little better.
    pub fn evaluate(&self, brightening: f64, others: &OtherBeams) -> CoLocationEvidence {
        let allowed = brightening.ln() + others.rise.unwrap_or(0.0).max(0.0);
        let step = self.steps.most_significant().unwrap_or_default();
        let mut evidence = CoLocationEvidence {
            energy: self.brightness.most_significant(allowed, others.scatter),
            jitter: self.jitter.most_significant(others.jitter),
            step,
            width: self.second_moment.most_significant(&others.second_moment),
            ..CoLocationEvidence::default()
        };
        if let Some(since) = step.since {
            evidence.energy_since = of_frames(self.brightness.frames_since(since), |n| {
                self.brightness.test(n, allowed, others.scatter)
            });
            evidence.jitter_since = of_frames(self.jitter.frames_since(since), |n| self.jitter.test(n, others.jitter));
        }
        evidence
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::monitor::stats::brightness::Light;

    fn light(ln_energy: f64) -> Light {
        Light {
            ln_energy,
            ln_gain: 0.0,
        }
    }

    fn excess(neg_log_p: f64) -> WindowExcess {
        WindowExcess { ratio: 2.0, neg_log_p }
    }

    #[test]
    fn no_evidence_is_no_second_beam() {
        assert_eq!(CoLocationEvidence::default().neg_log_p(), 0.0);
        let young = CoLocationTest::default().evaluate(1.35, &OtherBeams::default());
        assert_eq!(young.neg_log_p(), 0.0);
    }

    #[test]
    fn brightness_and_jitter_have_six_tenths_of_the_budget() {
        let evidence = CoLocationEvidence {
            energy: excess(10.0),
            jitter: excess(10.0),
            ..CoLocationEvidence::default()
        };
        // Erlang of two: 20 − ln 21; and ln 0.6 for the share.
        assert!((evidence.neg_log_p() - (20.0 - 21f64.ln() + 0.6f64.ln())).abs() < 1e-12);
    }

    #[test]
    fn a_step_adds_to_the_brightness_since() {
        let evidence = CoLocationEvidence {
            step: StepEvidence {
                length_m: 1.0,
                neg_log_p: 15.0,
                since: Some(Timestamp::UNIX_EPOCH),
            },
            energy_since: excess(8.0),
            ..CoLocationEvidence::default()
        };
        assert!((evidence.neg_log_p() - (23.0 - 24f64.ln() + 0.25f64.ln())).abs() < 1e-12);
    }

    #[test]
    fn a_remembered_beam_that_doubles_is_evidence() {
        let mut test = CoLocationTest::remembered(-5.0, 0.3);
        for k in 0..40 {
            assert!(!test.has_verdict());
            let time = Timestamp::from_millisecond(100 * k).unwrap();
            test.brightness.push(time, light(-5.0 + 2f64.ln()), false);
        }
        assert!(test.has_verdict());
        let evidence = test.evaluate(1.35, &OtherBeams::default());
        assert!((evidence.energy.ratio - 2.0).abs() < 1e-9);
        assert!(evidence.energy.neg_log_p > 15.0, "{evidence:?}");
        // Not if the others became as much brighter.
        let others = OtherBeams {
            rise: Some(2f64.ln()),
            ..OtherBeams::default()
        };
        assert_eq!(test.evaluate(1.35, &others).energy.neg_log_p, 0.0);
    }

    #[test]
    fn light_and_jitter_since_a_step_are_tested_from_three_frames_on() {
        // 30 past frames of noise show how steps scatter; then the centre steps aside by a metre and the spot becomes brighter.
        let mut test = CoLocationTest::remembered(0.0, 0.3);
        let at = |k: i64| Timestamp::from_millisecond(100 * k).unwrap();
        let mut since = Vec::new();
        for k in 0..70 {
            let is_joined = k >= 60;
            let place = nalgebra::Vector2::new(0.01 * f64::from(k as i32 % 3), f64::from(u8::from(is_joined)));
            let tried = test.steps.candidates(at(k), place, 1e-2);
            test.steps.push(&tried, &Default::default(), true);
            test.brightness
                .push(at(k), light(if is_joined { 1.0 } else { 0.0 }), true);
            let evidence = test.evaluate(1.35, &OtherBeams::default());
            if is_joined && evidence.step.since == Some(at(60)) {
                since.push((k, evidence.energy_since.neg_log_p > 0.0));
            }
        }
        // Three frames after the step show it, and the light of those three is tested.
        assert_eq!(since.first(), Some(&(62, true)), "{since:?}");
    }
}
