//! The sources of a frame and their energies.

use faer::Mat;

use super::exposure::{Exposure, NormalEquations, PER_SPOT, ScaledCholesky, Spot};
use crate::optics::{Camera, psf};

/// Matched-filter significance, in standard deviations, above which a residual becomes a source. Trades weak sources missed
/// against false ones, which would absorb light of a true one.
const DETECTION_SIGMAS: f64 = 12.0;

/// Solves for energies and background with positions fixed: a linear problem.
pub(super) fn solve_energies(exposure: &mut Exposure, camera: &Camera) {
    let n = exposure.spots.len();
    let normal = exposure.normal(camera);
    let linear: Vec<usize> = (0..n)
        .map(|i| PER_SPOT * i + 2)
        .chain(PER_SPOT * n..normal.rhs.len())
        .collect();
    let h = Mat::from_fn(linear.len(), linear.len(), |a, b| normal.gram[(linear[a], linear[b])]);
    let g: Vec<f64> = linear.iter().map(|&c| normal.rhs[c]).collect();
    if let Some(solution) = ScaledCholesky::new(&h, 1e-9).map(|s| s.solve(&g)) {
        for (spot, e) in exposure.spots.iter_mut().zip(&solution) {
            spot.energy_j = *e;
        }
        if let Some(background) = &mut exposure.background {
            background.copy_from_slice(&solution[n..]);
        }
    }
}

/// χ² of the background against none, marginal over the other unknowns of the frame.
pub(super) fn background_strength(exposure: &Exposure, normal: &NormalEquations, survey_var_m2: f64) -> Option<f64> {
    let background = exposure.background?;
    let (h, _) = exposure.with_survey_prior(normal, survey_var_m2);
    let inverse = ScaledCholesky::new(&h, 1e-12)?.solve_many(&Mat::identity(h.nrows(), h.nrows()));
    let first = 3 * exposure.spots.len();
    let covariance = Mat::from_fn(background.len(), background.len(), |a, b| {
        inverse[(first + a, first + b)]
    });
    let weighted = ScaledCholesky::new(&covariance, 0.0)?.solve(&background);
    Some(background.iter().zip(weighted).map(|(b, w)| b * w).sum())
}

/// Removes spots whose energy plus three standard deviations is below `least_j`. The standard deviation is large for two that
/// overlap, whose energies are determined only in sum.
pub(super) fn drop_dark(exposure: &mut Exposure, normal: &NormalEquations, survey_var_m2: f64, least_j: f64) {
    let (h, _) = exposure.with_survey_prior(normal, survey_var_m2);
    let Some(solver) = ScaledCholesky::new(&h, 1e-12) else {
        return;
    };
    let inverse = solver.solve_many(&Mat::identity(h.nrows(), h.nrows()));
    let mut i = 0;
    exposure.spots.retain(|spot| {
        let std = inverse[(3 * i + 2, 3 * i + 2)].max(0.0).sqrt();
        i += 1;
        spot.energy_j + 3.0 * std > least_j
    });
}

/// Adds a spot without a beacon at the strongest peak of the matched-filtered residual, if its energy is at least `least_j`.
/// Returns whether one was added.
pub(super) fn add_missing(exposure: &mut Exposure, camera: &Camera, least_j: f64) -> bool {
    let (ny, nx) = camera.shape();
    let mut residual = vec![0.0; ny * nx];
    exposure.residual(camera, &mut residual);
    let sigma = camera.spot_sigma_m;
    // Separable matched filter with kernels centred on each pixel.
    let kernels = |axis: &crate::optics::Axis| -> Vec<Vec<f64>> {
        (0..axis.n)
            .map(|k| {
                let mut out = vec![0.0; axis.n];
                psf::profile(axis, axis.centre(k), sigma, &mut out);
                out
            })
            .collect()
    };
    let (kx, ky) = (kernels(&camera.x), kernels(&camera.y));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let along_x: Vec<Vec<f64>> = residual
        .chunks_exact(nx)
        .map(|row| kx.iter().map(|k| dot(k, row)).collect())
        .collect();
    let norms = |k: &[Vec<f64>]| k.iter().map(|k| dot(k, k)).collect::<Vec<f64>>();
    let (norm_x, norm_y) = (norms(&kx), norms(&ky));
    let mut best: Option<(f64, f64, [f64; 2])> = None;
    for (row, k) in ky.iter().enumerate() {
        for col in 0..nx {
            let product: f64 = k.iter().zip(&along_x).map(|(w, line)| w * line[col]).sum();
            let norm2 = norm_x[col] * norm_y[row];
            let strength = product / norm2.sqrt();
            if best.is_none_or(|b| strength > b.0) {
                best = Some((strength, product / norm2, [camera.x.centre(col), camera.y.centre(row)]));
            }
        }
    }
    let Some((strength, energy_j, sensor_m)) = best else {
        return false;
    };
    let apart = |s: &Spot| (s.sensor_m[0] - sensor_m[0]).hypot(s.sensor_m[1] - sensor_m[1]) > 1.5 * sigma;
    if strength < DETECTION_SIGMAS * camera.noise_std_j || energy_j < least_j || !exposure.spots.iter().all(apart) {
        return false;
    }
    exposure.spots.push(Spot {
        beacon: None,
        predicted_m: sensor_m,
        sensor_m,
        energy_j,
        is_inlier: false,
    });
    true
}
