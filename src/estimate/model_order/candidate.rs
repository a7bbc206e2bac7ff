//! A hypothesis with its covariance and the splits that the score test proposes, which several proposals use.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use crate::estimate::emitter::SecondMomentScore;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::levenberg_marquardt::{evaluate, linearise};
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::uncertainty::covariance::Covariance;
use crate::estimate::uncertainty::split_score_test::{SplitProposal, second_moment_scores, split_proposal};

/// Precision added to positions, 1/σ², so that a source of no light has a covariance.
const POSITION_PRIOR: f64 = 1e-9;

/// A hypothesis and what was derived from it. Every change of the hypothesis drops what was derived.
#[derive(Clone)]
pub(crate) struct Candidate {
    hypothesis: Hypothesis,
    covariance: Derived<Option<Arc<Covariance>>>,
    splits: Derived<Arc<[SplitProposal]>>,
}

/// Derived from a hypothesis, if anybody asked for it.
type Derived<T> = Option<T>;

impl From<Hypothesis> for Candidate {
    fn from(hypothesis: Hypothesis) -> Self {
        Self {
            hypothesis,
            covariance: None,
            splits: None,
        }
    }
}

impl Deref for Candidate {
    type Target = Hypothesis;

    fn deref(&self) -> &Hypothesis {
        &self.hypothesis
    }
}

impl DerefMut for Candidate {
    fn deref_mut(&mut self) -> &mut Hypothesis {
        self.covariance = None;
        self.splits = None;
        &mut self.hypothesis
    }
}

impl Candidate {
    pub fn into_hypothesis(self) -> Hypothesis {
        self.hypothesis
    }

    /// What the hypothesis predicts, and its residual. Solving the amplitudes again changes nothing in a fitted hypothesis.
    pub fn evaluation<'w>(&mut self, context: &'w mut FitContext) -> &'w Evaluation {
        evaluate(context, &mut self.hypothesis)
    }

    /// The covariance of the parameters; `None` where the information is singular.
    pub fn covariance(&mut self, context: &mut FitContext) -> Option<Arc<Covariance>> {
        if self.covariance.is_none() {
            let at = linearise(
                context.problem(),
                &mut self.hypothesis,
                context.budget,
                context.workspace,
            );
            self.covariance = Some(Covariance::new(at.equations, POSITION_PRIOR).map(Arc::new));
        }
        self.covariance.clone().flatten()
    }

    /// The score in each source's second moments; none where the information is singular.
    pub fn second_moments(&mut self, context: &mut FitContext) -> Vec<SecondMomentScore> {
        if matches!(self.covariance, Some(None)) {
            return Vec::new();
        }
        let problem = context.problem();
        let mut at = linearise(problem, &mut self.hypothesis, context.budget, context.workspace);
        let covariance = self
            .covariance
            .get_or_insert_with(|| Covariance::new(at.equations, POSITION_PRIOR).map(Arc::new));
        match covariance {
            Some(covariance) => second_moment_scores(problem, &mut at, covariance, context.budget),
            None => Vec::new(),
        }
    }

    /// Splits suggested by the score test, the largest predicted gain first; none where the budget is spent.
    pub fn split_proposals(&mut self, context: &mut FitContext) -> Arc<[SplitProposal]> {
        if context.budget.is_exhausted() {
            return Arc::default();
        }
        if let Some(known) = &self.splits {
            return known.clone();
        }
        let scores = self.second_moments(context);
        let mut splits: Vec<_> = scores
            .iter()
            .enumerate()
            .filter_map(|(i, s)| split_proposal(s, i))
            .collect();
        splits.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        let splits: Arc<[SplitProposal]> = splits.into();
        self.splits = Some(splits.clone());
        splits
    }

    /// Squared amplitude over its variance, for each source (Wald's test); 0 where the information is singular.
    pub fn wald_statistics(&mut self, context: &mut FitContext) -> Vec<f64> {
        let covariance = self.covariance(context);
        let statistic = |(i, source): (usize, &PointSource)| {
            covariance
                .as_ref()
                .map_or(0.0, |c| source.a.powi(2) / c.at(i, 2, i, 2).max(1e-300))
        };
        self.hypothesis.sources.iter().enumerate().map(statistic).collect()
    }

    /// Predicted rise of the deviance, to second order, when sources i and j are merged; 0 where the information is singular.
    pub fn merge_deviance_rise(&mut self, context: &mut FitContext, i: usize, j: usize) -> f64 {
        let Some(c) = self.covariance(context) else { return 0.0 };
        let sources = &self.hypothesis.sources;
        let d = [0, 1].map(|k| sources[i].u[k] - sources[j].u[k]);
        let s =
            [0, 1].map(|r| [0, 1].map(|k| c.at(i, r, i, k) + c.at(j, r, j, k) - c.at(i, r, j, k) - c.at(j, r, i, k)));
        let det = s[0][0] * s[1][1] - s[0][1] * s[1][0];
        (d[0] * d[0] * s[1][1] - 2.0 * d[0] * d[1] * s[0][1] + d[1] * d[1] * s[0][0]) / det.max(1e-300)
    }
}
