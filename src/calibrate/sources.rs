//! Which sources a frame holds, and how bright they are.

use faer::Mat;

use super::shot::{Normal, PER_SPOT, Scaled, Shot, Spot};
use crate::optics::{Camera, psf};

/// Standard deviations of the residual that light without a spot must reach.
const SIGNIFICANT: f64 = 12.0;

/// Energies and background with the positions held where they are: a linear problem.
pub(super) fn solve_energies(shot: &mut Shot, camera: &Camera) {
    let n = shot.spots.len();
    let normal = shot.normal(camera);
    let linear: Vec<usize> = (0..n)
        .map(|i| PER_SPOT * i + 2)
        .chain(PER_SPOT * n..normal.rhs.len())
        .collect();
    let h = Mat::from_fn(linear.len(), linear.len(), |a, b| normal.gram[(linear[a], linear[b])]);
    let g: Vec<f64> = linear.iter().map(|&c| normal.rhs[c]).collect();
    if let Some(solution) = Scaled::new(&h, 1e-9).map(|s| s.solve(&g)) {
        for (spot, e) in shot.spots.iter_mut().zip(&solution) {
            spot.energy_j = *e;
        }
        if let Some(background) = &mut shot.background {
            background.copy_from_slice(&solution[n..]);
        }
    }
}

/// χ² of a frame's background against none, everything else of the frame fitted with it.
pub(super) fn background_strength(shot: &Shot, normal: &Normal, tether_m2: f64) -> Option<f64> {
    let background = shot.background?;
    let (h, _) = shot.tethered(normal, tether_m2);
    let inverse = Scaled::new(&h, 1e-12)?.solve_many(&Mat::identity(h.nrows(), h.nrows()));
    let first = 3 * shot.spots.len();
    let covariance = Mat::from_fn(background.len(), background.len(), |a, b| {
        inverse[(first + a, first + b)]
    });
    let weighted = Scaled::new(&covariance, 0.0)?.solve(&background);
    Some(background.iter().zip(weighted).map(|(b, w)| b * w).sum())
}

/// Drops the spots that surely have less energy than `least_j`: two that overlap may share theirs out at will.
pub(super) fn drop_dark(shot: &mut Shot, normal: &Normal, tether_m2: f64, least_j: f64) {
    let (h, _) = shot.tethered(normal, tether_m2);
    let Some(solver) = Scaled::new(&h, 1e-12) else { return };
    let inverse = solver.solve_many(&Mat::identity(h.nrows(), h.nrows()));
    let mut i = 0;
    shot.spots.retain(|spot| {
        let std = inverse[(3 * i + 2, 3 * i + 2)].max(0.0).sqrt();
        i += 1;
        spot.energy_j + 3.0 * std > least_j
    });
}

/// Puts a spot without a beacon on the strongest light that the residual holds, if it is worth `least_j`.
pub(super) fn add_missing(shot: &mut Shot, camera: &Camera, least_j: f64) -> bool {
    let (ny, nx) = camera.shape();
    let mut residual = vec![0.0; ny * nx];
    shot.residual(camera, &mut residual);
    let sigma = camera.spot_sigma_m;
    // Matched filter, one axis after the other: kernels centred on each pixel.
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
    if strength < SIGNIFICANT * camera.noise_std_j || energy_j < least_j || !shot.spots.iter().all(apart) {
        return false;
    }
    shot.spots.push(Spot {
        beacon: None,
        predicted_m: sensor_m,
        sensor_m,
        energy_j,
        trusted: false,
    });
    true
}
