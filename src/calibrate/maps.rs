//! Gain, dark level and bad pixels, from the residuals of the fitted spots.

use ndarray::Array2;

use super::exposure::Exposure;
use crate::optics::{Camera, PixelMaps};
use crate::stats::median;

/// Fewest frames that maps are estimated from.
const MIN_FRAMES: usize = 10;

/// Sums of one pixel over the frames: m is the expected value of an ideal pixel, z the recorded value minus m.
#[derive(Clone, Copy, Default)]
struct Sums {
    n: f64,
    m: f64,
    mm: f64,
    z: f64,
    zm: f64,
    zz: f64,
}

/// One frame as the maps see it: expected values of ideal pixels and recorded ones, J, and which are used; row by row.
#[derive(Clone)]
pub struct Pixels<'a> {
    pub ideal: Vec<f64>,
    pub recorded: &'a [f64],
    pub used: Vec<bool>,
}

/// The maps of fitted exposures. None when there are too few.
pub fn estimate(camera: &Camera, exposures: &[Exposure]) -> Option<PixelMaps> {
    let frames = exposures.iter().filter(|s| s.is_inlier).map(|exposure| {
        let mut ideal = vec![0.0; exposure.pixels.len()];
        exposure.ideal(camera, &mut ideal);
        Pixels {
            ideal,
            recorded: &exposure.pixels,
            used: exposure.valid.clone(),
        }
    });
    estimate_from(camera.shape(), camera.noise_std_j, frames)
}

/// Estimates the maps as the posterior mean of z = (g − 1)·m + d under Gaussian scatter of g around 1 and d around 0.
/// The two scatters are estimated too, by expectation-maximisation (empirical Bayes: Efron and Morris, 1973), so that
/// pixels with little light stay near the array's mean. None when there are too few frames.
pub fn estimate_from<'a>(
    (ny, nx): (usize, usize),
    noise_j: f64,
    frames: impl Iterator<Item = Pixels<'a>>,
) -> Option<PixelMaps> {
    let mut sums = vec![Sums::default(); ny * nx];
    let mut count = 0;
    for frame in frames {
        count += 1;
        for (p, sum) in sums.iter_mut().enumerate().filter(|(p, _)| frame.used[*p]) {
            let (m, z) = (frame.ideal[p], frame.recorded[p] - frame.ideal[p]);
            sum.n += 1.0;
            sum.m += m;
            sum.mm += m * m;
            sum.z += z;
            sum.zm += z * m;
            sum.zz += z * z;
        }
    }
    if count < MIN_FRAMES {
        return None;
    }
    let noise2 = noise_j.powi(2);
    let bad: Vec<bool> = find_bad(&sums, noise2);
    let good = |p: usize| !bad[p] && sums[p].n > 0.0;
    let (mut gain_var, mut dark_var): (f64, f64) = (0.02_f64.powi(2), noise2);
    let mut fitted = vec![Posterior::default(); sums.len()];
    for _ in 0..40 {
        let (mut gain_sum, mut dark_sum, mut count) = (0.0, 0.0, 0.0);
        for (p, sum) in sums.iter().enumerate() {
            fitted[p] = Posterior::of(sum, noise2, gain_var, dark_var);
            if good(p) {
                gain_sum += fitted[p].excess.powi(2) + fitted[p].excess_var;
                dark_sum += fitted[p].dark.powi(2) + fitted[p].dark_var;
                count += 1.0;
            }
        }
        if count == 0.0 {
            return None;
        }
        gain_var = (gain_sum / count).max(1e-16);
        dark_var = (dark_sum / count).max(1e-8 * noise2);
    }
    let value = |p: usize, v: f64| if good(p) { v } else { 0.0 };
    let excess = Array2::from_shape_fn((ny, nx), |(y, x)| value(y * nx + x, fitted[y * nx + x].excess));
    let dark_j = Array2::from_shape_fn((ny, nx), |(y, x)| value(y * nx + x, fitted[y * nx + x].dark));
    // The mean gain is absorbed by the energies.
    let mean = excess.sum() / (0..sums.len()).filter(|&p| good(p)).count() as f64;
    let bad = Array2::from_shape_vec((ny, nx), bad).expect("one flag a pixel");
    let gain = excess
        .mapv(|e| (1.0 + e) / (1.0 + mean))
        .mapv(|g| if g > 0.05 { g } else { 1.0 });
    Some(PixelMaps { gain, dark_j, bad })
}

#[derive(Clone, Copy, Default)]
struct Posterior {
    excess: f64,
    excess_var: f64,
    dark: f64,
    dark_var: f64,
}

impl Posterior {
    fn of(s: &Sums, noise2: f64, gain_var: f64, dark_var: f64) -> Self {
        let a = s.mm / noise2 + 1.0 / gain_var;
        let b = s.m / noise2;
        let d = s.n / noise2 + 1.0 / dark_var;
        let det = a * d - b * b;
        let (u, v) = (s.zm / noise2, s.z / noise2);
        Self {
            excess: (d * u - b * v) / det,
            excess_var: d / det,
            dark: (a * v - b * u) / det,
            dark_var: a / det,
        }
    }
}

/// A pixel is bad when its residual variance with its own gain and dark level is far above the median, or when its gain is far
/// from 1 with a small uncertainty.
fn find_bad(sums: &[Sums], noise2: f64) -> Vec<bool> {
    let free: Vec<Posterior> = sums
        .iter()
        .map(|s| Posterior::of(s, noise2, 1e6, 1e6 * noise2.max(f64::MIN_POSITIVE)))
        .collect();
    let left: Vec<f64> = sums
        .iter()
        .zip(&free)
        .map(|(s, f)| (s.zz - f.excess * s.zm - f.dark * s.z).max(0.0) / s.n.max(1.0))
        .collect();
    let used: Vec<f64> = sums
        .iter()
        .zip(&left)
        .filter(|(s, _)| s.n > 0.0)
        .map(|(_, l)| *l)
        .collect();
    let Some(typical) = median(used) else {
        return vec![true; sums.len()];
    };
    sums.iter()
        .zip(free.iter().zip(&left))
        .map(|(s, (f, &left))| {
            let scatter = (2.0 / s.n.max(1.0)).sqrt();
            let is_noisy = left > typical * (4.0 + 12.0 * scatter);
            let is_insensitive = f.excess_var < 0.01 && !(-0.5..1.0).contains(&f.excess);
            s.n == 0.0 || is_noisy || is_insensitive
        })
        .collect()
}
