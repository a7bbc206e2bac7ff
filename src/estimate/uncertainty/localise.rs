//! From a fitted hypothesis to positions on the ground, each with its covariance and flags.

use nalgebra::DMatrix;

use crate::estimate::emitter::{Emitter, Flags};
use crate::estimate::fit::context::FitContext;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::uncertainty::confidence::Confidence;
use crate::estimate::uncertainty::covariance::RIDGE;
use crate::estimate::uncertainty::pixel_posterior::pixel_posterior;
use crate::estimate::uncertainty::posterior_mean::PosteriorMoments;
use crate::optics::Camera;

/// A masked pixel within this distance, σ, sets a flag: 99 % of a spot's light lies within.
const MASKED_DISTANCE: f64 = 3.0;
/// A source within this distance of the edge, σ, is flagged: nearer, the edge cuts more than 2 % of its light.
pub(crate) const EDGE_DISTANCE: f64 = 2.0;
/// Condition number beyond which the ridge under the information matrix is no longer small against its least eigenvalue.
const MAX_CONDITION: f64 = 0.01 / RIDGE;

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
    let confidence = Confidence::of(context, hypothesis, posterior);
    let unresolved = confidence.unresolved(hypothesis);
    let quadratic = confidence.quadratic(context, hypothesis);
    let (bases, sigma) = (context.bases, camera.spot_sigma_m);
    let of_fit = [
        (Flags::NO_CONVERGENCE, !hypothesis.converged),
        (Flags::POOR_FIT, confidence.is_poor_fit()),
        (Flags::ILL_CONDITIONED, !(confidence.condition <= MAX_CONDITION)),
    ];
    let emitter = |(i, source): (usize, &PointSource)| {
        let mut flags = of_pixels(bases, frame, source);
        let of_source = [(Flags::UNRESOLVED, unresolved[i]), (Flags::NON_GAUSSIAN, !quadratic[i])];
        of_fit
            .into_iter()
            .chain(of_source)
            .for_each(|(flag, is_set)| flags.set(flag, is_set));
        let (mut u, mut cov) = (source.u, confidence.block(i, i));
        if confidence.is_regular() && posterior.is_none() {
            allow_for_pixels(bases, source, confidence.prior, &mut u, &mut cov);
        }
        if let Some(moments) = posterior_moments.map(|c| c[i]) {
            u = [0, 1].map(|k| u[k] + moments.shift[k]);
            cov = moments.covariance;
        }
        if let Some(smear) = frame.smear.as_ref().filter(|_| posterior.is_none()) {
            let of_light = smear.cov_of_light(u);
            cov = [0, 1].map(|r| [0, 1].map(|c| cov[r][c] + of_light[r][c]));
        }
        let sensor_m = u.map(|u| u * sigma);
        let scale = sigma * sigma * confidence.inflation;
        let [x_m, y_m] = camera.to_ground(sensor_m);
        Emitter {
            x_m,
            y_m,
            cov_m2: camera.cov_to_ground(sensor_m, cov.map(|r| r.map(|c| c * scale))),
            energy_j: source.a * noise_j,
            velocity: None,
            lasting_cov_m2: None,
            energy_std_j: confidence.energy_std(i, source.a) * noise_j,
            sensor_m,
            second_moment: confidence.scores[i],
            flags,
        }
    };
    Localised {
        emitters: hypothesis.sources.iter().enumerate().map(emitter).collect(),
        reduced_chi2: confidence.reduced_chi2,
        condition: confidence.condition,
    }
}

/// What the pixels around a source say of it: the sensor's edge, masked and saturated ones.
fn of_pixels(bases: &Bases, frame: &PreprocessedFrame, source: &PointSource) -> Flags {
    let axes = bases.axes();
    let mut flags = Flags::empty();
    let near_edge = (0..2).any(|k| {
        let edges = &axes[k].edges;
        source.u[k] < edges[0] + EDGE_DISTANCE || source.u[k] > edges[axes[k].n] - EDGE_DISTANCE
    });
    flags.set(Flags::NEAR_EDGE, near_edge);
    for bad in frame.flagged.iter().filter(|bad| !bad.is_foreign) {
        let offset = [bad.x, bad.y].map(|k| k as f64 + 0.5);
        let [x, y] = [0, 1].map(|k| axes[k].edges[0] + offset[k] * axes[k].pitch() - source.u[k]);
        if x * x + y * y < MASKED_DISTANCE * MASKED_DISTANCE {
            flags |= match bad.is_saturated {
                true => Flags::SATURATED,
                false => Flags::MASKED,
            };
        }
    }
    flags
}

/// The mean and covariance of a position where pixels are so wide that its likelihood is not that of a Gaussian.
fn allow_for_pixels(bases: &Bases, source: &PointSource, prior: f64, u: &mut [f64; 2], cov: &mut [[f64; 2]; 2]) {
    for k in 0..2 {
        if let Some(s) = pixel_posterior([&bases.x, &bases.y], k, source) {
            u[k] += s.shift;
            // Neighbours and nuisances widen this variance as they widen the information matrix's.
            let wider = (s.variance * (s.information + prior)).sqrt();
            for other in 0..2 {
                cov[k][other] *= wider;
                cov[other][k] *= wider;
            }
        }
    }
}
