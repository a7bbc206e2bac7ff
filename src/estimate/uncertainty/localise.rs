//! From a fitted hypothesis to positions on the ground, each with its covariance and flags.

use nalgebra::DMatrix;

use crate::estimate::emitter::{Emitter, Flags, SecondMomentScore};
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::linearise;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::model::hypothesis::{Hypothesis, OVERLAPPING};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::uncertainty::covariance::{Covariance, RIDGE, condition_number, position_information};
use crate::estimate::uncertainty::pixel_posterior;
use crate::estimate::uncertainty::posterior_mean::PosteriorMoments;
use crate::estimate::uncertainty::profile_nonlinearity::is_likelihood_quadratic;
use crate::estimate::uncertainty::split_score_test::{second_moment_scores, split_proposal};
use crate::optics::Camera;

/// A masked pixel within this distance, σ, sets a flag: 99 % of a spot's light lies within.
const MASKED_DISTANCE: f64 = 3.0;
/// A source within this distance of the edge, σ, is flagged: nearer, the edge cuts more than 2 % of its light.
pub(crate) const EDGE_DISTANCE: f64 = 2.0;
/// Condition number beyond which the ridge under the information matrix is no longer small against its least eigenvalue.
const MAX_CONDITION: f64 = 0.01 / RIDGE;
/// Sources this many standard deviations of their difference apart are resolved.
const RESOLVED: f64 = 3.0;
/// A source may be two where a split is predicted to decrease the deviance by this much: less than a source's penalty, so that a pair which
/// the search leaves as one is flagged. Less would flag lone sources by chance.
const DOUBTFUL: f64 = 10.0;

/// The emitters of a hypothesis, and how well it explains the frame.
pub(crate) struct Localised {
    pub emitters: Vec<Emitter>,
    /// Weighted squared residual per degree of freedom.
    pub reduced_chi2: f64,
    /// Condition number of the information matrix; infinite where it is singular.
    pub condition: f64,
}

/// Turns `hypothesis` into emitters with covariance and flags. `posterior` is the covariance of the positions (x, y of each source, σ²) where
/// more is known of them than what this frame says.
pub(crate) fn localise(
    context: &mut FitContext,
    hypothesis: &mut Hypothesis,
    frame: &PreprocessedFrame,
    camera: &Camera,
    noise_j: f64,
    posterior_moments: Option<&[PosteriorMoments]>,
    posterior: Option<&DMatrix<f64>>,
) -> Localised {
    let n = hypothesis.sources.len();
    let p = hypothesis.parameters();
    let (bases, compressed) = (context.bases, context.compressed);
    let (bx, by) = (&bases.x, &bases.y);
    let (low, high) = ([bx.edges[0], by.edges[0]], [bx.edges[bx.n], by.edges[by.n]]);
    let pitch = [bx.pitch(), by.pitch()];
    // The fit may place a source past the sensor's edges.
    let [extent_x, extent_y] = bases.reach();
    let extent = extent_x.max(extent_y);
    let prior = 12.0 / (extent * extent);
    let problem = context.problem();
    let mut at = linearise(problem, hypothesis, context.budget, context.workspace);
    let of_frame = Covariance::new(at.equations, prior);
    let known = posterior.map(|cov| {
        cov.clone()
            .cholesky()
            .map(|c| c.inverse())
            .zip(position_information(at.equations))
    });
    let covariance = match known.flatten() {
        Some((all, of_frame)) => Covariance::with_known(at.equations, prior, &(all - of_frame)),
        None => of_frame.clone(),
    };
    let condition = (covariance.as_ref()).map_or(f64::INFINITY, |c| condition_number(at.equations, c));
    // Where the weights allow for an inexact PSF, what pixels add to positions is not the inverse of their weights.
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
    let freedom = (compressed.data_count - p as f64).max(1.0);
    // The masked pixels' downdate may leave a small negative number.
    let reduced_chi2 = hypothesis.deviance.max(0.0) / freedom;
    let expected = compressed.mean_variance * freedom;
    let is_poor =
        hypothesis.deviance > expected + compressed.light_weighted_variance * (5.0 * (2.0 * freedom).sqrt() + 5.0);
    // A misfit inflates the covariance.
    let inflation = if is_poor { hypothesis.deviance / expected } else { 1.0 };
    let block = |i: usize, j: usize| {
        covariance.as_ref().map_or_else(
            || {
                let v = if i == j { extent * extent / 12.0 } else { 0.0 };
                [[v, 0.0], [0.0, v]]
            },
            |c| sandwiched.as_ref().unwrap_or(c).block(i, j),
        )
    };
    let is_regular = covariance.is_some();
    let is_merged = |i: usize| {
        let own = block(i, i);
        (0..n).filter(|&j| j != i).any(|j| {
            let d = [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k]);
            let (other, cross) = (block(j, j), block(i, j));
            let s = [0, 1].map(|r| [0, 1].map(|c| own[r][c] + other[r][c] - cross[r][c] - cross[c][r]));
            let along: f64 = (0..2).map(|r| (0..2).map(|c| d[r] * s[r][c] * d[c]).sum::<f64>()).sum();
            let d2 = d[0] * d[0] + d[1] * d[1];
            d2 * d2 < RESOLVED * RESOLVED * inflation * along
        })
    };
    let may_be_two = |i: usize| split_proposal(&scores[i], i).is_some_and(|s| s.gain > DOUBTFUL * inflation);
    let is_doubtful: Vec<bool> = (0..n).map(|i| !is_regular || is_merged(i) || may_be_two(i)).collect();
    let is_near = |i: usize, j: usize| {
        let d = [0, 1].map(|k| hypothesis.sources[i].u[k] - hypothesis.sources[j].u[k]);
        d[0].hypot(d[1]) < OVERLAPPING
    };
    let is_crowded = |i: usize| (0..n).any(|j| j != i && is_near(i, j));
    let is_quadratic: Vec<bool> = (0..n)
        .map(|i| match &covariance {
            Some(c) if is_crowded(i) => is_likelihood_quadratic(context, hypothesis, c, i),
            _ => true,
        })
        .collect();
    let sigma = camera.spot_sigma_m;
    let emitters = (0..n)
        .map(|i| {
            let source = hypothesis.sources[i];
            let mut flags = Flags::empty();
            flags.set(Flags::NO_CONVERGENCE, !hypothesis.converged);
            flags.set(Flags::POOR_FIT, is_poor);
            flags.set(Flags::ILL_CONDITIONED, !(condition <= MAX_CONDITION));
            let near_edge =
                (0..2).any(|k| source.u[k] < low[k] + EDGE_DISTANCE || source.u[k] > high[k] - EDGE_DISTANCE);
            flags.set(Flags::NEAR_EDGE, near_edge);
            for bad in frame.flagged.iter().filter(|bad| !bad.is_foreign) {
                let centre = [bad.x, bad.y].map(|k| k as f64 + 0.5);
                let d2: f64 = (0..2)
                    .map(|k| (low[k] + centre[k] * pitch[k] - source.u[k]).powi(2))
                    .sum();
                if d2 < MASKED_DISTANCE * MASKED_DISTANCE {
                    flags |= if bad.is_saturated {
                        Flags::SATURATED
                    } else {
                        Flags::MASKED
                    };
                }
            }
            let own = block(i, i);
            flags.set(Flags::UNRESOLVED, (0..n).any(|j| is_doubtful[j] && is_near(i, j)));
            flags.set(Flags::NON_GAUSSIAN, !is_quadratic[i]);
            let (mut u, mut own) = (source.u, own);
            for k in 0..if is_regular && posterior.is_none() { 2 } else { 0 } {
                if let Some(s) = pixel_posterior::pixel_posterior([bx, by], k, &source) {
                    u[k] += s.shift;
                    // Neighbours and nuisances widen this variance as they widen the information matrix's.
                    let wider = (s.variance * (s.information + prior)).sqrt();
                    for other in 0..2 {
                        own[k][other] *= wider;
                        own[other][k] *= wider;
                    }
                }
            }
            if let Some(moments) = posterior_moments.map(|c| c[i]) {
                for k in 0..2 {
                    u[k] += moments.shift[k];
                }
                own = moments.covariance;
            }
            if let Some(smear) = frame.smear.as_ref().filter(|_| posterior.is_none()) {
                let of_light = smear.cov_of_light(u);
                own = [0, 1].map(|r| [0, 1].map(|c| own[r][c] + of_light[r][c]));
            }
            let sensor_m = u.map(|u| u * sigma);
            let scale = sigma * sigma * inflation;
            let [x_m, y_m] = camera.to_ground(sensor_m);
            let energy_variance = (covariance.as_ref()).map_or(source.a * source.a, |c| c.at(i, 2, i, 2));
            Emitter {
                x_m,
                y_m,
                cov_m2: camera.cov_to_ground(sensor_m, own.map(|r| r.map(|c| c * scale))),
                energy_j: source.a * noise_j,
                velocity: None,
                lasting_cov_m2: None,
                // Two square roots: the product of the variances may overflow.
                energy_std_j: energy_variance.max(0.0).sqrt() * inflation.sqrt() * noise_j,
                sensor_m,
                second_moment: scores[i],
                flags,
            }
        })
        .collect();
    Localised {
        emitters,
        reduced_chi2,
        condition,
    }
}
