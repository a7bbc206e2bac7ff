//! Fits under the prior of energies, and the evidence of what was fitted.

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::{fit, fit_below, linearise};
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::criterion::NUISANCE_PENALTY;
use crate::estimate::model_order::power_prior::PowerPrior;
use crate::estimate::uncertainty::covariance::log_det;

/// Fits `hypothesis` under the prior in at most `steps` steps, and as many again where the assignment changes: sources are assigned with
/// `leniency` first and by their energy after the fit. Sets the log evidence term.
pub(crate) fn fit_with_prior(
    context: &mut FitContext,
    prior: &PowerPrior,
    hypothesis: &mut Hypothesis,
    steps: usize,
    acceptance_threshold: f64,
    leniency: f64,
) {
    prior.assign_components(hypothesis, leniency);
    fit_below(context, hypothesis, steps, acceptance_threshold);
    if prior.assign_components(hypothesis, 0.0) {
        fit(context, hypothesis, steps);
    }
    hypothesis.log_evidence_term = log_evidence_term(context, prior, hypothesis);
}

/// −2 ln of the Occam factor (Laplace; MacKay, 2003, eq. 28.10) and of the prior, which is uniform over the sensor in position and
/// symmetric in the emitters' order.
fn log_evidence_term(context: &mut FitContext, prior: &PowerPrior, hypothesis: &mut Hypothesis) -> f64 {
    let n = hypothesis.sources.len();
    let bases = context.bases;
    let [width, height] = bases.reach();
    let area = width * height;
    // The prior's precision of a position: never wider than the spot and a pixel.
    let least = |b: &Basis| 1.0 / (0.25 + b.pitch() * b.pitch() / 12.0);
    let floors = |s: &PointSource| [least(&bases.x), least(&bases.y), prior.least_precision(s)];
    let floor: Vec<_> = hypothesis.sources.iter().map(floors).collect();
    let at = linearise(context.problem(), hypothesis, context.budget, context.workspace);
    let log_det = log_det(at.equations, &floor).unwrap_or(f64::INFINITY);
    let orders: f64 = (2..=n).map(|k| 2.0 * (k as f64).ln()).sum();
    let volume = n as f64 * (2.0 * area.ln() - 3.0 * std::f64::consts::TAU.ln());
    let nuisances = NUISANCE_PENALTY * hypothesis.nuisances.count() as f64;
    prior.tempering * (log_det + volume - orders + nuisances) + prior.total_cost(hypothesis)
}
