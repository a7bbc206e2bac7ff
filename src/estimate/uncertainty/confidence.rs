//! How well a fitted hypothesis is known: the covariance of its parameters, what a misfit adds to it, and which sources it leaves in doubt.

use nalgebra::DMatrix;

use crate::estimate::emitter::SecondMomentScore;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::linearise;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::model::hypothesis::{Hypothesis, OVERLAPPING};
use crate::estimate::uncertainty::covariance::{Covariance, condition_number, position_information};
use crate::estimate::uncertainty::profile_nonlinearity::is_likelihood_quadratic;
use crate::estimate::uncertainty::split_score_test::{second_moment_scores, split_proposal};

/// Sources this many standard deviations of their difference apart are resolved.
const RESOLVED: f64 = 3.0;
/// A source may be two where a split is predicted to decrease the deviance by this much: less than a source's penalty, so that a pair which
/// the search leaves as one is flagged. Less would flag lone sources by chance.
const DOUBTFUL: f64 = 10.0;

pub(crate) struct Confidence {
    /// Of all parameters; none where the information matrix is singular.
    pub covariance: Option<Covariance>,
    /// The same where the weights allow for an inexact PSF: what pixels add to positions is then not the inverse of their weights.
    sandwiched: Option<Covariance>,
    /// Information on a position before the frame, 1/σ²: it lies on the sensor or near it.
    pub prior: f64,
    pub scores: Vec<SecondMomentScore>,
    /// Condition number of the information matrix; infinite where it is singular.
    pub condition: f64,
    /// Weighted squared residual per degree of freedom.
    pub reduced_chi2: f64,
    /// By which a misfit inflates the covariance: 1 where there is none.
    pub inflation: f64,
}

impl Confidence {
    /// `posterior` is the covariance of the positions (x, y of each source, σ²) where more is known of them than what this frame says.
    pub fn of(context: &mut FitContext, hypothesis: &mut Hypothesis, posterior: Option<&DMatrix<f64>>) -> Self {
        let n = hypothesis.sources.len();
        let compressed = context.compressed;
        // The fit may place a source past the sensor's edges.
        let [extent_x, extent_y] = context.bases.reach();
        let prior = 12.0 / extent_x.max(extent_y).powi(2);
        let problem = context.problem();
        let mut at = linearise(problem, hypothesis, context.budget, context.workspace);
        let of_frame = Covariance::new(at.equations, prior);
        let known = posterior.map(|cov| {
            let all = cov.clone().cholesky().map(|c| c.inverse());
            all.zip(position_information(at.equations))
        });
        let covariance = match known.flatten() {
            Some((all, of_frame)) => Covariance::with_known(at.equations, prior, &(all - of_frame)),
            None => of_frame.clone(),
        };
        let condition = (covariance.as_ref()).map_or(f64::INFINITY, |c| condition_number(at.equations, c));
        let (p_weights, evaluation) = (&compressed.position_weights, at.evaluation);
        let sandwiched = covariance.as_ref().filter(|_| compressed.has_spot_error()).map(|c| {
            let mut equations = NormalEquations::default();
            equations.compute_weighted(problem, p_weights, hypothesis.nuisances, evaluation, at.scratch);
            c.sandwich(&equations)
        });
        // An ill-conditioned fit leaves a sandwich that is no covariance; the inverse of the weights then stands.
        let is_covariance = |[[a, b], [_, c]]: [[f64; 2]; 2]| a > 0.0 && a * c > b * b;
        let sandwiched = sandwiched.filter(|s| (0..n).all(|i| is_covariance(s.block(i, i))));
        // Positions that others have led astray would look like spots that are wider.
        let scores = match &of_frame {
            Some(c) => second_moment_scores(problem, &mut at, c, context.budget),
            None => vec![SecondMomentScore::default(); n],
        };
        let freedom = (compressed.data_count - hypothesis.parameters() as f64).max(1.0);
        let expected = compressed.mean_variance * freedom;
        let most = expected + compressed.light_weighted_variance * (5.0 * (2.0 * freedom).sqrt() + 5.0);
        let is_poor = hypothesis.deviance > most;
        Self {
            covariance,
            sandwiched,
            prior,
            scores,
            condition,
            // The masked pixels' downdate may leave a small negative number.
            reduced_chi2: hypothesis.deviance.max(0.0) / freedom,
            inflation: if is_poor { hypothesis.deviance / expected } else { 1.0 },
        }
    }

    /// Covariance of the places of sources `i` and `j`, σ², without what a misfit adds.
    pub fn block(&self, i: usize, j: usize) -> [[f64; 2]; 2] {
        match self.sandwiched.as_ref().or(self.covariance.as_ref()) {
            Some(covariance) => covariance.block(i, j),
            None => {
                let anywhere = if i == j { 1.0 / self.prior } else { 0.0 };
                [[anywhere, 0.0], [0.0, anywhere]]
            }
        }
    }

    pub fn is_regular(&self) -> bool {
        self.covariance.is_some()
    }

    pub fn is_poor_fit(&self) -> bool {
        self.inflation > 1.0
    }

    /// Standard deviation of a source's energy `a`, which is as uncertain as it is large where nothing tells it.
    pub fn energy_std(&self, i: usize, a: f64) -> f64 {
        let variance = (self.covariance.as_ref()).map_or(a * a, |c| c.at(i, 2, i, 2));
        // Two square roots: the product of the variances may overflow.
        variance.max(0.0).sqrt() * self.inflation.sqrt()
    }

    /// Of each source, whether it overlaps one that may be two or may be one with another, itself included.
    pub fn unresolved(&self, hypothesis: &Hypothesis) -> Vec<bool> {
        let n = hypothesis.sources.len();
        let is_doubtful = |i: usize| {
            let may_be_two = || split_proposal(&self.scores[i], i).is_some_and(|s| s.gain > DOUBTFUL * self.inflation);
            let may_be_one = || (0..n).any(|j| j != i && !self.are_apart(hypothesis, i, j));
            !self.is_regular() || may_be_one() || may_be_two()
        };
        let doubtful: Vec<bool> = (0..n).map(is_doubtful).collect();
        (0..n)
            .map(|i| (0..n).any(|j| doubtful[j] && distance(hypothesis, i, j) < OVERLAPPING))
            .collect()
    }

    /// Whether two sources are farther apart than their errors along the line between them.
    fn are_apart(&self, hypothesis: &Hypothesis, i: usize, j: usize) -> bool {
        let d = difference(hypothesis, i, j);
        let (one, other, cross) = (self.block(i, i), self.block(j, j), self.block(i, j));
        let s = [0, 1].map(|r| [0, 1].map(|c| one[r][c] + other[r][c] - cross[r][c] - cross[c][r]));
        let along: f64 = (0..2).map(|r| (0..2).map(|c| d[r] * s[r][c] * d[c]).sum::<f64>()).sum();
        let d2 = d[0] * d[0] + d[1] * d[1];
        d2 * d2 >= RESOLVED * RESOLVED * self.inflation * along
    }

    /// Of each source, whether its likelihood is that of a Gaussian.
    pub fn quadratic(&self, context: &mut FitContext, hypothesis: &Hypothesis) -> Vec<bool> {
        let n = hypothesis.sources.len();
        let is_crowded = |i: usize| (0..n).any(|j| j != i && distance(hypothesis, i, j) < OVERLAPPING);
        let mut is_quadratic = |i: usize| match &self.covariance {
            Some(c) if is_crowded(i) => is_likelihood_quadratic(context, hypothesis, c, i),
            _ => true,
        };
        (0..n).map(&mut is_quadratic).collect()
    }
}

fn difference(hypothesis: &Hypothesis, i: usize, j: usize) -> [f64; 2] {
    [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k])
}

fn distance(hypothesis: &Hypothesis, i: usize, j: usize) -> f64 {
    let [x, y] = difference(hypothesis, i, j);
    x.hypot(y)
}
