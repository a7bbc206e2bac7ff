//! The criterion that hypotheses are compared by: a penalised likelihood, or the evidence where users' powers are known.

use crate::estimate::model::hypothesis::{Hypothesis, Width};
use crate::estimate::model_order::power_prior::PowerPrior;

/// Least decrease of the deviance for a nuisance parameter: the 97.5 % point of χ² with one degree of freedom, as each is tested once.
pub(crate) const NUISANCE_PENALTY: f64 = 5.0;
/// Slack on the acceptance bound for the unknown evidence term: larger fits hopeless candidates further, smaller aborts some that the
/// evidence would have accepted.
const ACCEPTANCE_SLACK: f64 = 30.0;

/// −2 ln of a hypothesis's likelihood with the penalties of its sources and nuisances, or of its posterior probability.
#[derive(Clone, Copy)]
pub(crate) struct Criterion<'a> {
    /// Least decrease of the deviance for a source, where the noise is as configured.
    pub source_penalty: f64,
    /// Noise variance weighted by the frame's light: multiplies all penalties.
    pub noise_inflation: f64,
    /// The prior of energies, for the evidence; without it the likelihood is penalised.
    pub prior: Option<&'a PowerPrior>,
}

/// The matched filter has about area/σ² independent positions; the penalty keeps the probability that any of them exceeds it in an empty
/// frame below 1e-3.
///
/// The sensor's widths are in σ.
pub(crate) fn source_penalty([x, y]: [f64; 2]) -> f64 {
    (10.0 + 2.0 * (x * y).ln()).max(14.0)
}

impl Criterion<'_> {
    /// The lower, the better.
    pub fn score(&self, hypothesis: &Hypothesis) -> f64 {
        hypothesis.deviance + hypothesis.prior_penalty() + self.penalty(hypothesis)
    }

    /// Decrease of the deviance that a source must bring in this frame's noise.
    pub fn threshold(&self) -> f64 {
        self.noise_inflation * self.source_penalty
    }

    /// Deviance below which `next` scores better than `best`.
    pub fn acceptance_threshold(&self, best: &Hypothesis, next: &Hypothesis) -> f64 {
        let penalty = match self.prior {
            None => self.penalty(next),
            // The evidence term is known only after the fit: one more source of a known power may even lower it.
            Some(_) if best.sources.is_empty() => return f64::INFINITY,
            Some(_) => {
                best.log_evidence_term * (next.sources.len() as f64 / best.sources.len() as f64).min(1.0)
                    - ACCEPTANCE_SLACK
            }
        };
        self.score(best) - penalty
    }

    fn penalty(&self, hypothesis: &Hypothesis) -> f64 {
        if self.prior.is_some() {
            return self.noise_inflation * hypothesis.log_evidence_term;
        }
        let nuisances = NUISANCE_PENALTY * hypothesis.nuisances.count() as f64;
        // A pair explains one elliptical spot too, and is likelier than an elliptical PSF: an ellipse costs a source more.
        let penalised = hypothesis.sources.len() + usize::from(hypothesis.nuisances.width == Width::RotatedEllipse);
        self.noise_inflation * (self.source_penalty * penalised as f64 + nuisances)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::model::hypothesis::{Background, Nuisances, PointSource};

    #[test]
    fn a_source_must_decrease_the_deviance_by_its_penalty_times_the_noise() {
        let criterion = Criterion {
            source_penalty: 20.0,
            noise_inflation: 1.5,
            prior: None,
        };
        let mut one = Hypothesis::empty(Nuisances::default());
        one.sources.push(PointSource::new([0.0; 2], 10.0));
        one.deviance = 500.0;
        assert_eq!(criterion.score(&one), 530.0);
        let mut two = one.clone();
        two.sources.push(PointSource::new([5.0, 0.0], 10.0));
        two.deviance = criterion.acceptance_threshold(&one, &two);
        assert_eq!(two.deviance, 470.0);
        assert_eq!(criterion.score(&two), criterion.score(&one));
        two.nuisances = Nuisances {
            background: Background::Plane,
            width: Width::RotatedEllipse,
        };
        // Three sources' penalties and six nuisances'.
        assert_eq!(criterion.score(&two), 470.0 + 1.5 * (3.0 * 20.0 + 6.0 * 5.0));
    }
}
