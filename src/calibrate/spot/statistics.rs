//! What residuals say: noise, shot noise, and by how much the spot differs from its template.

use faer::Mat;
use ndarray::Array2;

use super::constraints::{HALO, norm, sigma_equivalent_m};
use super::detection::Dither;
use super::learn::Learner;
use crate::calibrate::exposure::ScaledCholesky;
use crate::stats::median;

/// Rings around spots, σ, within each of which the template's error is measured.
const RINGS: [f64; 6] = [0.0, 1.5, 3.0, 5.0, 8.0, 12.0];
/// Standard deviations from which a figure counts.
const SIGNIFICANT: f64 = 3.0;
/// Residuals beyond this many σ are outliers, with what a template that is this wrong would add.
const OUTLIER: f64 = 5.0;
const LARGEST_ERROR: f64 = 0.05;

/// Squared residuals of a learner's images regressed on what makes them.
#[derive(Clone, Copy, Debug)]
pub struct Variance {
    /// Noise of a pixel without light, J.
    pub read_noise_j: f64,
    /// Growth of the variance with the expected energy, J; none where it does not show.
    pub quantum_j: Option<f64>,
    /// Share of a spot's light by which it differs from the template, anywhere in its halo.
    pub spot_error: f64,
}

/// A squared residual, and what of each cause a fit leaves in it.
struct Pixel {
    squared: f64,
    read: f64,
    light: f64,
    halo2: f64,
    /// Of the nearest spot, σ.
    distance: f64,
    /// Whether that spot is one of those judged.
    is_judged: bool,
}

/// Regresses r² = σ² + g·E + (s·H)², H = E·‖spot‖/(1 + (d/3σ)²) over the pixels in use, each less what the spots' own parameters absorb.
pub fn variance(learner: &Learner) -> Variance {
    let pixels = pixels(learner, |_, _| true);
    let noise2 = learner.noise_j.powi(2);
    let typical: f64 = pixels
        .iter()
        .map(|p| p.light.abs())
        .fold(0.0, f64::max)
        .max(learner.noise_j);
    let scale = [noise2, typical, pixels.iter().map(|p| p.halo2).fold(noise2, f64::max)];
    let mut now = [1.0, 0.0, 0.0];
    let mut covariance = Mat::<f64>::identity(3, 3);
    for _ in 0..4 {
        let mut h = Mat::<f64>::zeros(3, 3);
        let mut g = vec![0.0; 3];
        for p in &pixels {
            let row = [p.read, p.light / scale[1], p.halo2 / scale[2]];
            let expected = row.iter().zip(&now).map(|(a, b)| a * b).sum::<f64>().max(0.2 * now[0]);
            let squared = p.squared / noise2;
            if squared > OUTLIER * OUTLIER * expected {
                continue;
            }
            // The variance of r² is twice the square of its mean.
            let weight = 0.5 / (expected * expected);
            for a in 0..3 {
                g[a] += weight * row[a] * squared;
                for b in 0..3 {
                    h[(a, b)] += weight * row[a] * row[b];
                }
            }
        }
        let Some(solver) = ScaledCholesky::new(&h, 1e-9) else {
            break;
        };
        let x = solver.solve(&g);
        covariance = solver.solve_many(&Mat::identity(3, 3));
        now = [x[0].max(0.01), x[1].max(0.0), x[2].max(0.0)];
    }
    let gain = now[1] * noise2 / scale[1];
    let is_shot = now[1] > SIGNIFICANT * covariance[(1, 1)].max(0.0).sqrt();
    let quantum_j = is_shot.then_some(gain).filter(|g| *g > 0.0);
    let read2 = now[0] * noise2;
    Variance {
        read_noise_j: read2.sqrt(),
        quantum_j,
        spot_error: spot_error(&pixels, read2, quantum_j.unwrap_or(0.0)),
    }
}

/// The spot error of the spots of frames and places that `is_judged` says, where the variance is known.
pub fn spot_error_at(learner: &Learner, variance: &Variance, is_judged: impl Fn(usize, [f64; 2]) -> bool) -> f64 {
    let mut pixels = pixels(learner, is_judged);
    pixels.retain(|p| p.is_judged);
    spot_error(
        &pixels,
        variance.read_noise_j.powi(2),
        variance.quantum_j.unwrap_or(0.0),
    )
}

/// Largest over the rings of √(excess of r² over the noise / H²), where it is significant.
fn spot_error(pixels: &[Pixel], read2: f64, gain: f64) -> f64 {
    let rings = RINGS.windows(2).map(|ring| {
        let (mut excess, mut halo2, mut var) = (0.0, 0.0, 0.0);
        for p in pixels.iter().filter(|p| (ring[0]..ring[1]).contains(&p.distance)) {
            let noise2 = p.read * read2 + gain * p.light;
            if p.squared > OUTLIER * OUTLIER * (noise2 + (LARGEST_ERROR * LARGEST_ERROR) * p.halo2) {
                continue;
            }
            // Weighted by H²/σ⁴, which is best where the error is small.
            let weight = p.halo2 / (noise2 * noise2);
            excess += weight * (p.squared - noise2);
            halo2 += weight * p.halo2;
            var += weight * weight * 2.0 * noise2 * noise2;
        }
        match excess > SIGNIFICANT * var.sqrt() {
            true => (excess / halo2).sqrt(),
            false => 0.0,
        }
    });
    rings.fold(0.0, f64::max)
}

fn pixels(learner: &Learner, is_judged: impl Fn(usize, [f64; 2]) -> bool) -> Vec<Pixel> {
    let camera = learner.camera;
    let sigma = sigma_equivalent_m(camera, &learner.model);
    let norm = norm(camera, &learner.model);
    let mut out = Vec::new();
    for patch in &learner.patches {
        let Some(linearised) = patch.linearise(camera, &learner.model) else {
            continue;
        };
        let expected = patch.expected(camera, &learner.model);
        let (causes, nearest): (Vec<[f64; 3]>, Vec<(f64, bool)>) = (expected.iter().enumerate())
            .map(|(k, e)| {
                let x = camera.x.centre(patch.x.start + k % patch.x.len());
                let y = camera.y.centre(patch.y.start + k / patch.x.len());
                let (mut halo, mut nearest) = (0.0, (f64::INFINITY, false));
                for s in &patch.sources {
                    let d = (s.at[0] - x).hypot(s.at[1] - y) / sigma;
                    halo += s.energy_j * norm / (1.0 + (d / HALO).powi(2));
                    if d < nearest.0 {
                        nearest = (d, is_judged(patch.frame, s.at));
                    }
                }
                ([1.0, (e - patch.background).max(0.0), halo * halo], nearest)
            })
            .unzip();
        let left = residual_squares(linearised.jacobian_and_inverse(patch), &causes);
        for (k, [read, light, halo2]) in left.into_iter().enumerate().filter(|(k, _)| patch.weight[*k] > 0.0) {
            out.push(Pixel {
                squared: (patch.data[k] - expected[k]).powi(2),
                read,
                light,
                halo2,
                distance: nearest[k].0,
                is_judged: nearest[k].1,
            });
        }
    }
    out
}

/// Expected squares of the residuals of a fit of this Jacobian and its inverse where the data's independent errors have each of `variances`: the
/// diagonal of M·diag(v)·M, M = I − H (Hartley, Rao and Kiefer, 1969).
fn residual_squares<const N: usize>(
    (jacobian, inverse): (Mat<f64>, Mat<f64>),
    variances: &[[f64; N]],
) -> Vec<[f64; N]> {
    let shares: [Mat<f64>; N] = std::array::from_fn(|n| {
        let weighted = |k: usize, c: usize| jacobian[(k, c)] * variances[k][n];
        let inner = jacobian.transpose() * Mat::from_fn(jacobian.nrows(), jacobian.ncols(), weighted);
        inner * &inverse
    });
    let column_product =
        |a: &Mat<f64>, b: &Mat<f64>, k: usize| (0..a.nrows()).map(|c| a[(c, k)] * b[(c, k)]).sum::<f64>();
    let transposed = jacobian.transpose().to_owned();
    let of = |k: usize| {
        let leverage = column_product(&inverse, &transposed, k);
        std::array::from_fn(|n| variances[k][n] * (1.0 - 2.0 * leverage) + column_product(&inverse, &shares[n], k))
    };
    (0..jacobian.nrows()).map(of).collect()
}

/// Half-width of [`mean_residual`], σ.
const PICTURED: f64 = 8.0;

/// Mean residual of whole pixels around spots, over the spots' energies times `norm`: (2n + 1, 2n + 1), rows in y.
pub fn mean_residual(learner: &Learner, norm: f64) -> Array2<f64> {
    let camera = learner.camera;
    let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
    let n = (PICTURED * camera.spot_sigma_m / pitch).ceil().clamp(4.0, 40.0) as i64;
    let side = 2 * n as usize + 1;
    let (mut sum, mut weight) = (Array2::<f64>::zeros((side, side)), Array2::<f64>::zeros((side, side)));
    for patch in &learner.patches {
        let expected = patch.expected(camera, &learner.model);
        for s in &patch.sources {
            let pixel = |k: usize| {
                let (axis, range) = [(&camera.x, &patch.x), (&camera.y, &patch.y)][k];
                ((s.at[k] - axis.min_m) / axis.pitch_m).floor() as i64 - range.start as i64
            };
            let (i0, j0) = (pixel(0) - n, pixel(1) - n);
            for ((j, i), total) in sum.indexed_iter_mut() {
                let (x, y) = (i0 + i as i64, j0 + j as i64);
                if !(0..patch.x.len() as i64).contains(&x) || !(0..patch.y.len() as i64).contains(&y) {
                    continue;
                }
                let p = y as usize * patch.x.len() + x as usize;
                if patch.weight[p] > 0.0 {
                    // Σ E·r / Σ E² is the share of the light that is missing there.
                    *total += s.energy_j * (patch.data[p] - expected[p]);
                    weight[(j, i)] += s.energy_j.powi(2);
                }
            }
        }
    }
    sum.zip_mut_with(&weight, |s, w| *s = if *w > 0.0 { *s / w / norm } else { 0.0 });
    sum
}

/// Standard deviation of most pixels' weighted residuals, 1 where the noise is as assumed.
pub fn residual_scale(learner: &Learner) -> f64 {
    let (camera, model) = (learner.camera, &learner.model);
    let mut dither = Dither::of(camera);
    let magnitudes = learner.patches.iter().flat_map(|patch| {
        let expected = patch.expected(camera, model).into_iter().zip(&patch.data);
        let weighted = expected.zip(&patch.weight).filter(|(_, w)| **w > 0.0);
        weighted
            .map(|((e, d), w)| ((d - e + dither.next_j()) * w).abs())
            .collect::<Vec<f64>>()
    });
    // A median magnitude is 0.6745 standard deviations of a Gaussian.
    let scale = median(magnitudes.collect()).map_or(1.0, |m| m / 0.6745);
    (dither.taken_off(scale * learner.noise_j) / learner.noise_j).max(1e-6)
}

/// Matched signal-to-noise ratio of all spots together.
pub fn information(learner: &Learner) -> f64 {
    let energies = learner
        .patches
        .iter()
        .flat_map(|p| &p.sources)
        .map(|s| s.energy_j.powi(2));
    energies.sum::<f64>().sqrt() * norm(learner.camera, &learner.model) / learner.noise_j
}

/// Signal-to-noise ratio of the brightest pixel of a spot in the middle of a pixel: median and largest over the spots.
pub fn peak_snr(learner: &Learner) -> [f64; 2] {
    let model = &learner.model;
    let peak = model.coefficients[..model.n * model.n]
        .iter()
        .fold(0.0f64, |a, b| a.max(*b));
    let pixel = learner.camera.x.pitch_m * learner.camera.y.pitch_m / model.knot_m.powi(2);
    let energies: Vec<f64> = learner
        .patches
        .iter()
        .flat_map(|p| &p.sources)
        .map(|s| s.energy_j)
        .collect();
    let largest = energies.iter().copied().fold(0.0, f64::max);
    [median(energies).unwrap_or(0.0), largest].map(|e| e * (peak * pixel).min(1.0) / learner.noise_j)
}

/// Share of the spots' light, root mean square over their pixels, that the template leaves unexplained beyond the noise, `noise` times the
/// learner's, whose variance grows by `quantum_j` per joule.
pub fn unexplained(learner: &Learner, noise: f64, quantum_j: f64) -> f64 {
    let noise2 = noise * noise;
    let (mut excess, mut own) = (0.0, 0.0);
    for patch in &learner.patches {
        let expected = patch.expected(learner.camera, &learner.model);
        for ((e, d), w) in expected.iter().zip(&patch.data).zip(&patch.weight) {
            let light = e - patch.background;
            let read2 = if *w > 0.0 { noise2 } else { 0.0 };
            excess += ((d - e) * w).powi(2) - read2 - quantum_j * light.max(0.0) * w * w;
            own += (light * w).powi(2);
        }
    }
    (excess.max(0.0) / own.max(1.0)).sqrt()
}
