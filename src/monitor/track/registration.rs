//! The pose error that all beams of one frame share, found from where their tracks expect them, and taken out of the detections.
//!
//! Detection j of track i is z = x + H·ξ + noise, ξ the error of the frame's pose, common to all. With the track's prediction
//! as x's prior the posterior of ξ given all tracks but i (Gaussian, linear) makes z − H·ξ a measurement of x alone, whose
//! covariance says what is left of the common error: all of it where one beam is all there is. With C the posterior's covariance given
//! all, and W the weight of i in it, that without i is H·C·Hᵀ over 1 − H·C·Hᵀ·W (Woodbury, 1950).

use nalgebra::{Matrix2, Matrix6, Vector2, Vector6};

use super::beam_track::{GATE, GATE_FLOOR_M, Track};
use super::detection::Detection;
use crate::assign::assign;
use crate::monitor::stats::gaussian::mahalanobis2;

/// Standard deviation by which a beam may leave its track's course between two frames, m: a walker who turns does by 0.1 m.
/// Larger takes less of the common error out, smaller takes a turning user for it.
const COURSE_M: f64 = 0.1;
/// Rounds of reweighting, and the distance, in standard deviations, at which a beam's weight is a half (Cauchy): users who jump
/// must not move the others.
const ROUNDS: usize = 4;
const HALF_WEIGHT: f64 = 2.5;
/// Standard deviations below which a pose is not taken to be known, rad and m: keeps the prior regular, and changes a place by
/// less than a millimetre.
const LEAST_RAD: f64 = 1e-6;
const LEAST_M: f64 = 1e-4;

/// The error of a frame's pose against the tracks, and its covariance.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Turn about north, east, down, rad; shift east, north, up, m.
    pub error: Vector6<f64>,
    pub cov: Matrix6<f64>,
}

struct Pair {
    detection: usize,
    innovation: Vector2<f64>,
    cov: Matrix2<f64>,
    inverse_cov: Matrix2<f64>,
    /// Hᵀ S⁻¹ H and Hᵀ S⁻¹ ν.
    information: Matrix6<f64>,
    vector: Vector6<f64>,
    weight: f64,
}

/// Takes the pose error that `detections` share out of them, but for a share of it that is `left` (0 to 1), by which the tracks
/// themselves are moved. `tracks` are predicted to their time, and `prior` is the covariance of the pose. `None` where the prior is
/// no covariance.
pub fn register(
    tracks: &[Track],
    detections: &mut [Detection],
    prior: &Matrix6<f64>,
    left: f64,
) -> Option<Registration> {
    let least = [LEAST_RAD, LEAST_RAD, LEAST_RAD, LEAST_M, LEAST_M, LEAST_M].map(|s| s * s);
    let prior = prior + Matrix6::from_diagonal(&least.into());
    let prior_information = prior.cholesky()?.inverse();
    let mut pairs = pairs(tracks, detections, &prior);
    let posterior = |pairs: &[Pair]| {
        let (mut information, mut vector) = (prior_information, Vector6::zeros());
        for pair in pairs {
            information += pair.information * pair.weight;
            vector += pair.vector * pair.weight;
        }
        let factor = information.cholesky()?;
        Some((factor.solve(&vector), factor))
    };
    let (mut error, mut factor) = posterior(&pairs)?;
    for _ in 0..ROUNDS {
        for pair in &mut pairs {
            let h = &detections[pair.detection].by_pose;
            let d2 = mahalanobis2(pair.innovation - h * error, pair.cov);
            pair.weight = 1.0 / (1.0 + d2 / (HALF_WEIGHT * HALF_WEIGHT));
        }
        (error, factor) = posterior(&pairs)?;
    }
    let cov = factor.inverse();
    let common = |detection: &Detection| {
        let h = &detection.by_pose;
        (h * error, h * cov * h.transpose())
    };
    let mut shifts: Vec<_> = detections.iter().map(common).collect();
    for pair in &pairs {
        let (shift, spread) = &mut shifts[pair.detection];
        let own = *spread * pair.inverse_cov * pair.weight;
        let others = (Matrix2::identity() - own).try_inverse()?;
        *shift = others * (*shift - own * pair.innovation);
        *spread = others * *spread;
    }
    for (detection, (shift, spread)) in detections.iter_mut().zip(shifts) {
        detection.position -= shift * (1.0 - left);
        detection.cov += 0.5 * (spread + spread.transpose());
    }
    Some(Registration { error, cov })
}

/// Confirmed tracks that stand alone, each with its detection. A shift that all share changes which assignment is least by
/// nothing, so that pairs are right even where the common error is wider than the users are apart.
fn pairs(tracks: &[Track], detections: &[Detection], prior: &Matrix6<f64>) -> Vec<Pair> {
    let known: Vec<&Track> = tracks
        .iter()
        .filter(|t| t.confirmed && t.unresolved_from.is_none())
        .collect();
    let floor = Matrix2::identity() * GATE_FLOOR_M.powi(2);
    let spread = |d: &Detection| d.cov + floor + d.by_pose * prior * d.by_pose.transpose();
    let spreads: Vec<_> = detections.iter().map(spread).collect();
    let matching = assign(known.len(), detections.len(), GATE, |i, j| {
        let cov = known[i].filter.position_cov() + spreads[j];
        mahalanobis2(detections[j].position - known[i].filter.position(), cov)
    });
    let pair = |(i, j): (usize, usize)| {
        let d = &detections[j];
        let innovation = d.position - known[i].filter.position();
        let cov = known[i].filter.position_cov() + d.cov + Matrix2::identity() * COURSE_M.powi(2);
        let inverse_cov = cov.try_inverse()?;
        let weighted = d.by_pose.transpose() * inverse_cov;
        Some(Pair {
            detection: j,
            innovation,
            cov,
            inverse_cov,
            information: weighted * d.by_pose,
            vector: weighted * innovation,
            weight: 1.0,
        })
    };
    matching.pairs.into_iter().filter_map(pair).collect()
}
