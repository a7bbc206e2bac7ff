//! Whether one spot is two beams: brightness, jitter, a step aside and width, combined into one −ln p.

use jiff::Timestamp;

use super::brightness::{Brightness, Scatter, WINDOWS};
use super::gaussian::neg_log_p_of_sum;
use super::jitter::{Jitter, SecondDifference};
use super::second_moment::{CommonMode, SecondMomentScore, SecondMomentTest};
use super::step_change::{StepDetector, StepEvidence};

/// Frames since a step from which brightness and jitter since then are tested.
const MIN_FRAMES_AFTER: usize = 3;

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
    pub energy_ratio: f64,
    pub energy_neg_log_p: f64,
    /// Jitter from frame to frame over what is expected.
    pub jitter_ratio: f64,
    pub jitter_neg_log_p: f64,
    pub step: StepEvidence,
    /// Of brightness and jitter since the step.
    pub energy_neg_log_p_since: f64,
    pub jitter_neg_log_p_since: f64,
    /// Second moment beyond one spot's, σ².
    pub widening: f64,
    pub width_neg_log_p: f64,
}

impl CoLocationEvidence {
    /// All together. Energies, positions and shapes are independent; several of their sums are tested, each with its share of the
    /// chance of a false alert. Two beams on top of each other have the shape of one; one that was there from the start made
    /// no step.
    pub fn neg_log_p(&self) -> f64 {
        let (energy, jitter, width) = (self.energy_neg_log_p, self.jitter_neg_log_p, self.width_neg_log_p);
        let (step, energy_since, jitter_since) = (
            self.step.neg_log_p,
            self.energy_neg_log_p_since,
            self.jitter_neg_log_p_since,
        );
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

    /// Whether enough frames have been seen to say that there is no second beam.
    pub fn has_verdict(&self) -> bool {
        self.brightness.frames() >= WINDOWS[2]
    }

    /// Takes a frame's ln energy and second moments. With `learn` what grows old is added to the past.
    pub fn push_light(&mut self, time: Timestamp, ln_energy: f64, moments: &SecondMomentScore, learn: bool) {
        self.second_moment.push(moments, learn);
        self.brightness.push(time, ln_energy, learn);
    }

    /// Takes a frame's second difference, less what all beams have in common.
    pub fn push_jitter(&mut self, difference: SecondDifference, learn: bool) {
        self.jitter.push(difference, learn);
    }

    /// A beam may honestly become brighter by the factor `brightening`: it is pointed a little better.
    pub fn evaluate(&self, brightening: f64, others: &OtherBeams) -> CoLocationEvidence {
        let allowed = brightening.ln() + others.rise.unwrap_or(0.0).max(0.0);
        let brighter = self.brightness.most_significant(allowed, others.scatter);
        let jitter = self.jitter.most_significant(others.jitter);
        let step = self.steps.most_significant().unwrap_or_default();
        let wider = self.second_moment.most_significant(&others.second_moment);
        let mut evidence = CoLocationEvidence {
            energy_ratio: brighter.ratio,
            energy_neg_log_p: brighter.neg_log_p,
            jitter_ratio: jitter.ratio,
            jitter_neg_log_p: jitter.neg_log_p,
            step,
            widening: wider.trace,
            width_neg_log_p: wider.neg_log_p,
            ..CoLocationEvidence::default()
        };
        if let Some(since) = step.since {
            let enough = |n: usize| (n >= MIN_FRAMES_AFTER).then_some(n);
            let energy = enough(self.brightness.frames_since(since))
                .and_then(|n| self.brightness.test(n, allowed, others.scatter));
            let jitter = enough(self.jitter.frames_since(since)).and_then(|n| self.jitter.test(n, others.jitter));
            evidence.energy_neg_log_p_since = energy.map_or(0.0, |e| e.neg_log_p);
            evidence.jitter_neg_log_p_since = jitter.map_or(0.0, |j| j.neg_log_p);
        }
        evidence
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_evidence_is_no_second_beam() {
        assert_eq!(CoLocationEvidence::default().neg_log_p(), 0.0);
        let young = CoLocationTest::default().evaluate(1.35, &OtherBeams::default());
        assert_eq!(young.neg_log_p(), 0.0);
    }

    #[test]
    fn brightness_and_jitter_have_six_tenths_of_the_budget() {
        let evidence = CoLocationEvidence {
            energy_neg_log_p: 10.0,
            jitter_neg_log_p: 10.0,
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
            energy_neg_log_p_since: 8.0,
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
            test.push_light(time, -5.0 + 2f64.ln(), &SecondMomentScore::default(), false);
        }
        assert!(test.has_verdict());
        let evidence = test.evaluate(1.35, &OtherBeams::default());
        assert!((evidence.energy_ratio - 2.0).abs() < 1e-9);
        assert!(evidence.energy_neg_log_p > 15.0, "{evidence:?}");
        // Not if the others became as much brighter.
        let others = OtherBeams {
            rise: Some(2f64.ln()),
            ..OtherBeams::default()
        };
        assert_eq!(test.evaluate(1.35, &others).energy_neg_log_p, 0.0);
    }
}
