//! The Cramér–Rao bound: no unbiased estimator has a smaller error covariance.

use faer::{Mat, Side};

use crate::optics::{Axis, Camera, psf};

/// Bound on the squared error of each emitter's ground position, both axes summed, m², with all positions and energies
/// unknown: the position blocks of (JᵀJ/σ_n²)⁻¹ (Kay, 1993, eq. 3.31). `positions` on the ground, m; `energies` J.
/// Emitters that the frame cannot tell apart get a finite but enormous bound.
pub fn position_bound(camera: &Camera, positions: &[[f64; 2]], energies: &[f64]) -> Vec<f64> {
    let n = positions.len().min(energies.len());
    let sigma = camera.spot_sigma_m;
    let profile = |axis: &Axis, centre: f64| -> [Vec<f64>; 2] {
        let density = |edge: f64| {
            let t = (edge - centre) / sigma;
            (-0.5 * t * t).exp() / (2.0 * std::f64::consts::PI).sqrt()
        };
        let mut value = vec![0.0; axis.n];
        psf::profile(axis, centre, sigma, &mut value);
        let slope = (0..axis.n)
            .map(|k| density(axis.edge(k)) - density(axis.edge(k + 1)))
            .collect();
        [value, slope]
    };
    let atoms: Vec<_> = positions
        .iter()
        .map(|&p| {
            let s = camera.to_sensor(p);
            (profile(&camera.x, s[0]), profile(&camera.y, s[1]))
        })
        .collect();
    let inner = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    // Which of x and y is differentiated, for each of (x, y, energy).
    const DERIVATIVES: [[usize; 2]; 3] = [[1, 0], [0, 1], [0, 0]];
    let mut information = Mat::<f64>::zeros(3 * n, 3 * n);
    for i in 0..n {
        for j in 0..n {
            for (r, d) in DERIVATIVES.iter().enumerate() {
                for (c, e) in DERIVATIVES.iter().enumerate() {
                    let scale = |k: usize, spot: usize| {
                        if k < 2 {
                            energies[spot] / camera.noise_std_j
                        } else {
                            1.0
                        }
                    };
                    information[(3 * i + r, 3 * j + c)] = scale(r, i)
                        * scale(c, j)
                        * inner(&atoms[i].0[d[0]], &atoms[j].0[e[0]])
                        * inner(&atoms[i].1[d[1]], &atoms[j].1[e[1]]);
                }
            }
        }
    }
    let scales: Vec<f64> = (0..3 * n).map(|k| information[(k, k)].max(1e-300).sqrt()).collect();
    let scaled = Mat::from_fn(3 * n, 3 * n, |r, c| information[(r, c)] / (scales[r] * scales[c]));
    let Ok(eigen) = scaled.self_adjoint_eigen(Side::Lower) else {
        return vec![f64::INFINITY; n];
    };
    let (u, values) = (eigen.U(), eigen.S());
    let variance = |k: usize| {
        let sum: f64 = (0..3 * n).map(|m| u[(k, m)].powi(2) / values[m].max(1e-16)).sum();
        sum / scales[k].powi(2)
    };
    (0..n)
        .map(|i| {
            let v = [variance(3 * i) * sigma * sigma, variance(3 * i + 1) * sigma * sigma];
            let cov = camera.cov_to_ground(camera.to_sensor(positions[i]), [[v[0], 0.0], [0.0, v[1]]]);
            cov[0][0] + cov[1][1]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lone_spot_has_the_textbook_bound() {
        let config = crate::optics::Config {
            spot_sigma_m: Some(1e-3),
            pixels: [100, 100],
            ..Default::default()
        };
        let camera = config.camera().unwrap();
        let bound = position_bound(&camera, &[[3.0, -7.0]], &[7e-3])[0];
        // Finely sampled in white noise: σ_x² = 8π σ⁴ σ_n²/(pitch² A²) an axis.
        let pitch = camera.x.pitch_m;
        let axis = 8.0 * std::f64::consts::PI * 1e-12 * 1e-12 / (pitch * pitch * 49e-6);
        let expected = 2.0 * axis * camera.ground_scale().powi(2);
        // A pixel of 0.3 σ widens the spot by pitch²/12: 0.75 % of σ², 1.5 % of σ⁴.
        assert!((bound / expected - 1.0).abs() < 0.02, "{bound} against {expected}");
    }
}
