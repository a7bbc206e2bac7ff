//! The Cramér–Rao bound: no unbiased estimator has a smaller error covariance.

use faer::{Mat, Side};

use crate::optics::psf::PixelResponse;
use crate::optics::{Camera, DisplacedSpots, add_spot, psf};

/// What the bound assumes beside unknown positions and energies: further parameters, masked pixels, prior knowledge.
#[derive(Clone, Copy, Debug, Default)]
pub struct BoundAssumptions<'a> {
    pub shape: PsfShape,
    /// A constant and two slopes.
    pub background: bool,
    /// Masked pixels (Ny × Nx, row-major).
    pub masked: Option<&'a [bool]>,
    /// Standard deviation of each emitter's energy, J, where it is known beforehand as well as that; every emitter is then
    /// known to be in view too. Good while errors are small: an estimator may go below where a position is hardly known.
    pub known: Option<&'a [f64]>,
    /// How motion smears the spots, where they are Gaussian.
    pub smear: Option<&'a DisplacedSpots>,
}

/// Which parameters of the common PSF are unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PsfShape {
    #[default]
    Known,
    /// A width.
    Width,
    /// Widths along both axes and the covariance between them.
    Ellipse,
}

const DARK: PixelResponse = PixelResponse {
    fraction: 0.0,
    d_centre: 0.0,
    d_sigma: 0.0,
};

/// Bound on the squared error of each emitter's ground position, both axes summed, m², with all positions and energies
/// unknown: the position blocks of (JᵀJ/σ_n²)⁻¹ (Kay, 1993, eq. 3.31). `positions` on the ground, m; `energies` J.
/// Unresolved emitters get a finite but enormous bound.
pub fn position_bound(camera: &Camera, positions: &[[f64; 2]], energies: &[f64]) -> Vec<f64> {
    position_bound_with(camera, positions, energies, BoundAssumptions::default())
}

/// [`position_bound`] where more is unknown than positions and energies, and where pixels are missing.
pub fn position_bound_with(
    camera: &Camera,
    positions: &[[f64; 2]],
    energies: &[f64],
    assumptions: BoundAssumptions,
) -> Vec<f64> {
    let n = positions.len().min(energies.len());
    let jacobian = jacobian(camera, &positions[..n], energies, assumptions);
    let p = jacobian.ncols();
    let sigma = camera.spot_sigma_m;
    let mut information = jacobian.transpose() * &jacobian;
    // Bayesian information adds to Fisher's (Van Trees, 1968, ch. 2), as if what is known were Gaussian.
    for (i, std) in assumptions.known.iter().flat_map(|k| k.iter()).enumerate().take(n) {
        for (k, axis) in [&camera.x, &camera.y].into_iter().enumerate() {
            information[(3 * i + k, 3 * i + k)] += 3.0 * (sigma / axis.half_width()).powi(2);
        }
        information[(3 * i + 2, 3 * i + 2)] += (camera.noise_std_j / std).powi(2);
    }
    let scales: Vec<f64> = (0..p).map(|k| information[(k, k)].max(1e-300).sqrt()).collect();
    let scaled = Mat::from_fn(p, p, |r, c| information[(r, c)] / (scales[r] * scales[c]));
    let Ok(eigen) = scaled.self_adjoint_eigen(Side::Lower) else {
        return vec![f64::INFINITY; n];
    };
    let (u, values) = (eigen.U(), eigen.S());
    let variance = |k: usize| {
        let sum: f64 = (0..p).map(|m| u[(k, m)].powi(2) / values[m].max(1e-16)).sum();
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

/// Derivatives of every pixel over the noise, (pixels, parameters): x and y (in σ) and energy of each emitter, then what
/// is fitted beside.
fn jacobian(camera: &Camera, positions: &[[f64; 2]], energies: &[f64], assumptions: BoundAssumptions) -> Mat<f64> {
    let n = positions.len();
    let sigma = camera.spot_sigma_m;
    let shape = match assumptions.shape {
        PsfShape::Known => 0,
        PsfShape::Width => 1,
        PsfShape::Ellipse => 3,
    };
    let background = if assumptions.background { 3 } else { 0 };
    let mut jacobian = Mat::<f64>::zeros(camera.x.n * camera.y.n, 3 * n + shape + background);
    let is_usable = |pixel: usize| assumptions.masked.is_none_or(|bad| !bad[pixel]);
    if camera.spot_shape.is_some() {
        measured_columns(camera, positions, energies, &is_usable, &mut jacobian);
    }
    let (mut row, mut column) = (vec![DARK; camera.x.n], vec![DARK; camera.y.n]);
    let of_gaussian = if camera.spot_shape.is_some() {
        &[][..]
    } else {
        positions
    };
    for (i, &p) in of_gaussian.iter().enumerate() {
        let [x, y] = camera.to_sensor(p);
        let parts = assumptions.smear.map_or(&[(0.0, 1.0)][..], |smear| &smear.nodes);
        let [dx, dy] = assumptions
            .smear
            .map_or([0.0; 2], |smear| smear.displacement([x / sigma, y / sigma]));
        for (part, share) in parts {
            psf::profile_response(&camera.x, x + part * dx * sigma, sigma, &mut row);
            psf::profile_response(&camera.y, y + part * dy * sigma, sigma, &mut column);
            let signal = share * energies[i] / camera.noise_std_j;
            for (b, fy) in column.iter().enumerate() {
                for (a, fx) in row.iter().enumerate() {
                    let pixel = b * camera.x.n + a;
                    if !is_usable(pixel) {
                        continue;
                    }
                    jacobian[(pixel, 3 * i)] += signal * sigma * fx.d_centre * fy.fraction;
                    jacobian[(pixel, 3 * i + 1)] += signal * sigma * fx.fraction * fy.d_centre;
                    jacobian[(pixel, 3 * i + 2)] += share * fx.fraction * fy.fraction;
                    let along = [fx.d_sigma * fy.fraction, fx.fraction * fy.d_sigma];
                    match assumptions.shape {
                        PsfShape::Known => {}
                        PsfShape::Width => jacobian[(pixel, 3 * n)] += signal * sigma * (along[0] + along[1]),
                        PsfShape::Ellipse => {
                            jacobian[(pixel, 3 * n)] += signal * sigma * along[0];
                            jacobian[(pixel, 3 * n + 1)] += signal * sigma * along[1];
                            jacobian[(pixel, 3 * n + 2)] += signal * sigma * sigma * fx.d_centre * fy.d_centre;
                        }
                    }
                }
            }
        }
    }
    if assumptions.background {
        for pixel in (0..jacobian.nrows()).filter(|&k| is_usable(k)) {
            let (a, b) = (pixel % camera.x.n, pixel / camera.x.n);
            jacobian[(pixel, 3 * n + shape)] = 1.0;
            jacobian[(pixel, 3 * n + shape + 1)] = camera.x.centre(a) / camera.x.half_width();
            jacobian[(pixel, 3 * n + shape + 2)] = camera.y.centre(b) / camera.y.half_width();
        }
    }
    jacobian
}

/// The columns of positions and energies where the spot is measured, by central differences.
fn measured_columns(
    camera: &Camera,
    positions: &[[f64; 2]],
    energies: &[f64],
    is_usable: &dyn Fn(usize) -> bool,
    jacobian: &mut Mat<f64>,
) {
    // A thousandth of the spot's width: truncation 1e-6, cancellation 1e-13.
    const STEP: f64 = 1e-3;
    let sigma = camera.spot_sigma_m;
    let spot = |at: [f64; 2], energy_j: f64| {
        let mut pixels = vec![0.0; camera.x.n * camera.y.n];
        add_spot(camera, at, energy_j, &mut pixels);
        pixels
    };
    for (i, &position) in positions.iter().enumerate() {
        let at = camera.to_sensor(position);
        let signal = energies[i] / camera.noise_std_j;
        for k in 0..2 {
            let moved = |sign: f64| {
                let mut place = at;
                place[k] += sign * STEP * sigma;
                spot(place, signal)
            };
            let (up, down) = (moved(1.0), moved(-1.0));
            for pixel in (0..up.len()).filter(|&p| is_usable(p)) {
                jacobian[(pixel, 3 * i + k)] = (up[pixel] - down[pixel]) / (2.0 * STEP);
            }
        }
        let one = spot(at, 1.0);
        for pixel in (0..one.len()).filter(|&p| is_usable(p)) {
            jacobian[(pixel, 3 * i + 2)] = one[pixel];
        }
    }
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

    #[test]
    fn known_energies_resolve_an_overlapping_pair() {
        let config = crate::optics::Config {
            spot_sigma_m: Some(4e-3),
            pixels: [40, 40],
            ..Default::default()
        };
        let camera = config.camera().unwrap();
        let (pair, energies) = ([[0.0, 0.0], [1.0, 0.0]], [7e-3; 2]);
        let bound = |std: f64| {
            let known = [std; 2];
            let assumptions = BoundAssumptions {
                known: Some(&known),
                ..Default::default()
            };
            position_bound_with(&camera, &pair, &energies, assumptions)[0]
        };
        let plain = position_bound(&camera, &pair, &energies)[0];
        let bounds: Vec<f64> = [1e-1, 1e-3, 1e-4].map(bound).into();
        assert!(bounds.windows(2).all(|b| b[1] < b[0]), "{bounds:?} fall");
        assert!(bounds[2] < 0.5 * plain, "{bounds:?} against {plain}");
        // In view is somewhere within a hundred metres or so.
        assert!(bounds[0] < 2.0 * 72.0f64.powi(2), "{bounds:?}");
    }
}
