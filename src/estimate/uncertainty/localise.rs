//! From a fitted model to positions on the ground, each with its covariance and flags.

use crate::estimate::emitter::{Bend, Emitter, Estimate, Flags};
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Model;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::screening::Screened;
use crate::estimate::uncertainty::covariance::RIDGE;
use crate::estimate::uncertainty::pixel_posterior;
use crate::estimate::uncertainty::posterior_mean::Centre;
use crate::optics::Camera;

/// Unusable pixels this near, σ, are told to the reader.
const NEAR: f64 = 3.0;
/// From the edge, σ.
const EDGE: f64 = 2.0;
/// Condition number beyond which the ridge under the information matrix is no longer small against its least eigenvalue.
const MOST_CONDITION: f64 = 0.01 / RIDGE;
/// Two emitters this many standard deviations of their difference apart are two.
const RESOLVED: f64 = 3.0;
/// An emitter may be two where a split promises this drop of the deviance, though not the price of another emitter.
const DOUBTFUL: f64 = 10.0;
/// Emitters nearer than this, σ, to such a one, or to a pair that is not resolved, may be displaced by it.
const TOUCHING: f64 = 2.5;

/// Turns `model` into what the frame holds.
pub(crate) fn locate(
    search: &mut Search,
    reading: &Reading,
    model: &mut Model,
    frame: &Screened,
    camera: &Camera,
    noise_j: f64,
    centres: Option<&[Centre]>,
) -> Estimate {
    let n = model.spots.len();
    let p = model.parameters();
    search.fitter.information(reading, model);
    let freedom = (reading.numbers - p as f64).max(1.0);
    // Taking unusable pixels out of a sum of squares may leave less than nothing by rounding.
    let reduced_chi2 = model.deviance.max(0.0) / freedom;
    let expected = reading.mean_variance * freedom;
    let is_poor = model.deviance > expected + reading.lit_variance * (5.0 * (2.0 * freedom).sqrt() + 5.0);
    // A misfit widens the claim: the covariance speaks for what was found, not for what was hoped.
    let inflation = if is_poor { model.deviance / expected } else { 1.0 };
    let (bx, by) = (&search.fitter.bx, &search.fitter.by);
    let (low, high) = ([bx.edges[0], by.edges[0]], [bx.edges[bx.n], by.edges[by.n]]);
    let pitch = [bx.pitch(), by.pitch()];
    // Wherever the fit may place an emitter, past the sensor's edges too.
    let extent = (bx.highest() - bx.lowest()).max(by.highest() - by.lowest());
    let prior = 12.0 / (extent * extent);
    let mut cov = Vec::new();
    let is_regular = search.fitter.covariance(p, n, prior, &mut cov);
    let condition = if is_regular {
        search.fitter.condition(p, &cov)
    } else {
        f64::INFINITY
    };
    let bends = match is_regular {
        true => search.fitter.bends(reading, model, &cov),
        false => vec![Bend::default(); n],
    };
    let block = |i: usize, j: usize| {
        if is_regular {
            [0, 1].map(|r| [0, 1].map(|c| cov[(3 * i + r) * p + 3 * j + c]))
        } else {
            let v = if i == j { extent * extent / 12.0 } else { 0.0 };
            [[v, 0.0], [0.0, v]]
        }
    };
    let is_merged = |i: usize| {
        let own = block(i, i);
        (0..n).filter(|&j| j != i).any(|j| {
            let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
            let (other, cross) = (block(j, j), block(i, j));
            let s = [0, 1].map(|r| [0, 1].map(|c| own[r][c] + other[r][c] - cross[r][c] - cross[c][r]));
            let along: f64 = (0..2).map(|r| (0..2).map(|c| d[r] * s[r][c] * d[c]).sum::<f64>()).sum();
            let d2 = d[0] * d[0] + d[1] * d[1];
            d2 * d2 < RESOLVED * RESOLVED * inflation * along
        })
    };
    let may_be_two = |i: usize| bends[i].split(i).is_some_and(|s| s.gain > DOUBTFUL * inflation);
    let is_doubtful: Vec<bool> = (0..n).map(|i| !is_regular || is_merged(i) || may_be_two(i)).collect();
    let is_near = |i: usize, j: usize| {
        let d = [0, 1].map(|k| model.spots[i].u[k] - model.spots[j].u[k]);
        d[0].hypot(d[1]) < TOUCHING
    };
    let is_crowded = |i: usize| (0..n).any(|j| j != i && is_near(i, j));
    let is_straight: Vec<bool> = (0..n)
        .map(|i| !is_regular || !is_crowded(i) || search.is_straight(reading, model, &cov, i))
        .collect();
    let (bx, by) = (&search.fitter.bx, &search.fitter.by);
    let sigma = camera.spot_sigma_m;
    let emitters = (0..n)
        .map(|i| {
            let spot = model.spots[i];
            let mut flags = Flags::empty();
            flags.set(Flags::NO_CONVERGENCE, !model.converged);
            flags.set(Flags::POOR_FIT, is_poor);
            flags.set(Flags::ILL_CONDITIONED, !(condition <= MOST_CONDITION));
            let near_edge = (0..2).any(|k| spot.u[k] < low[k] + EDGE || spot.u[k] > high[k] - EDGE);
            flags.set(Flags::NEAR_EDGE, near_edge);
            for bad in &frame.bad {
                let centre = [bad.x, bad.y].map(|k| k as f64 + 0.5);
                let d2: f64 = (0..2)
                    .map(|k| (low[k] + centre[k] * pitch[k] - spot.u[k]).powi(2))
                    .sum();
                if d2 < NEAR * NEAR {
                    flags |= if bad.is_saturated {
                        Flags::SATURATED
                    } else {
                        Flags::MASKED
                    };
                }
            }
            let own = block(i, i);
            flags.set(Flags::UNRESOLVED, (0..n).any(|j| is_doubtful[j] && is_near(i, j)));
            flags.set(Flags::NON_GAUSSIAN, !is_straight[i]);
            let (mut u, mut own) = (spot.u, own);
            for k in 0..if is_regular { 2 } else { 0 } {
                if let Some(s) = pixel_posterior::along([bx, by], k, &spot) {
                    u[k] += s.shift;
                    // What neighbours and nuisances add to the information matrix's claim they add to this one.
                    let wider = (s.variance * (s.information + prior)).sqrt();
                    for other in 0..2 {
                        own[k][other] *= wider;
                        own[other][k] *= wider;
                    }
                }
            }
            if let Some(centre) = centres.map(|c| c[i]) {
                for k in 0..2 {
                    u[k] += centre.shift[k];
                }
                own = centre.covariance;
            }
            let sensor_m = u.map(|u| u * sigma);
            let scale = sigma * sigma * inflation;
            let [x_m, y_m] = camera.to_ground(sensor_m);
            let energy_variance = if is_regular {
                cov[(3 * i + 2) * p + 3 * i + 2]
            } else {
                spot.a * spot.a
            };
            Emitter {
                x_m,
                y_m,
                cov_m2: camera.cov_to_ground(sensor_m, own.map(|r| r.map(|c| c * scale))),
                energy_j: spot.a * noise_j,
                // The product of the two variances may leave the range of f64.
                energy_std_j: energy_variance.max(0.0).sqrt() * inflation.sqrt() * noise_j,
                sensor_m,
                bend: bends[i],
                flags,
            }
        })
        .collect();
    Estimate {
        emitters,
        rung: "",
        is_cut_short: false,
        reduced_chi2,
        saturated_share: frame.saturated as f64 / frame.pixels.len() as f64,
        condition,
        steps: search.fitter.steps,
    }
}
