//! The image of a spot, integrated over pixels, tabulated by its place relative to them.

use ndarray::Array2;

use crate::optics::{Axis, Camera};

/// What a pixel collects of a unit spot, by the pixel's centre from the spot's: samples a whole fraction of a pixel apart, as
/// coefficients of the interpolating cubic B-spline (Unser, 1999).
#[derive(Debug)]
pub(super) struct ImageTable {
    /// Samples a pixel along x and along y.
    per_pixel: [usize; 2],
    /// From the middle of the table to its first sample, in samples.
    middle: [usize; 2],
    coefficients: Array2<f64>,
}

/// Samples of the finest structure and of a pixel, at least: cubic splines are then good to 10⁻⁵ of the peak.
const PER_STRUCTURE: f64 = 10.0;
const FEWEST: usize = 8;
const MOST: usize = 48;

impl ImageTable {
    /// Integrates a density of x and y from the spot's centre, m, on any scale, over pixels; its light is normalised to 1 within
    /// `radius_m`. `finest_m`: the length over which it changes.
    pub fn of_density(camera: &Camera, finest_m: f64, radius_m: f64, density: &dyn Fn(f64, f64) -> f64) -> Self {
        let axes = [&camera.x, &camera.y];
        let per_pixel = axes.map(|a| {
            ((PER_STRUCTURE * a.pitch_m / finest_m).ceil() as usize)
                .clamp(FEWEST, MOST)
                .next_multiple_of(2)
        });
        let step: [f64; 2] = std::array::from_fn(|k| axes[k].pitch_m / per_pixel[k] as f64);
        // No spot's light is needed further out than the sensor is wide.
        let reach = |k: usize| (radius_m.min(2.0 * axes[k].half_width()) / step[k]).ceil() as usize + 1;
        let middle = [reach(0), reach(1)];
        let mut fine = Array2::from_shape_fn((2 * middle[1] + 1, 2 * middle[0] + 1), |(j, i)| {
            let at = |k: usize, i: usize| (i as f64 - middle[k] as f64) * step[k];
            density(at(0, i), at(1, j))
        });
        let total = fine.sum();
        fine.mapv_inplace(|v| v / total);
        Self::of_samples(fine, per_pixel)
    }

    /// From samples that add up to 1, the middle one on the spot's centre.
    pub fn of_samples(mut samples: Array2<f64>, per_pixel: [usize; 2]) -> Self {
        // Room for the pixel that only touches the spot.
        let (ny, nx) = samples.dim();
        let [mx, my] = per_pixel;
        let mut wide = Array2::zeros((ny + 2 * my, nx + 2 * mx));
        wide.slice_mut(ndarray::s![my..my + ny, mx..mx + nx]).assign(&samples);
        samples = wide;
        let boxed = |mut line: ndarray::ArrayViewMut1<f64>, m: usize| {
            // A pixel reaches m/2 samples to either side; Simpson's rule, in samples.
            let values = line.to_vec();
            let half = (m / 2) as isize;
            for (k, out) in line.iter_mut().enumerate() {
                *out = (-half..=half)
                    .map(|d| {
                        let weight = match (d + half) % 2 {
                            _ if d.abs() == half => 1.0,
                            1 => 4.0,
                            _ => 2.0,
                        };
                        let at = k.checked_add_signed(d).and_then(|p| values.get(p));
                        weight / 3.0 * at.copied().unwrap_or(0.0)
                    })
                    .sum();
            }
            prefilter(&mut line);
        };
        samples.rows_mut().into_iter().for_each(|line| boxed(line, mx));
        samples.columns_mut().into_iter().for_each(|line| boxed(line, my));
        let (ny, nx) = samples.dim();
        Self {
            per_pixel,
            middle: [nx / 2, ny / 2],
            coefficients: samples,
        }
    }

    pub fn len(&self) -> usize {
        self.coefficients.len()
    }

    /// Adds a spot of energy `energy_j` at `centre` to `pixels`, row-major (Ny, Nx), J.
    pub fn add(&self, camera: &Camera, centre: [f64; 2], energy_j: f64, pixels: &mut [f64]) {
        let (x, y) = (self.along(&camera.x, 0, centre[0]), self.along(&camera.y, 1, centre[1]));
        let table = self.coefficients.as_slice().expect("built in standard layout");
        let width = self.coefficients.dim().1;
        for j in y.pixels.clone() {
            let row = y.sample(j);
            for i in x.pixels.clone() {
                let column = x.sample(i);
                let mut sum = 0.0;
                for (b, wy) in y.weights.iter().enumerate() {
                    let line = &table[(row + b) * width + column..][..4];
                    sum += wy * line.iter().zip(&x.weights).map(|(c, w)| c * w).sum::<f64>();
                }
                pixels[j * camera.x.n + i] += energy_j * sum;
            }
        }
    }

    fn along(&self, axis: &Axis, k: usize, centre: f64) -> Along {
        let per_pixel = self.per_pixel[k];
        let length = [self.coefficients.dim().1, self.coefficients.dim().0][k];
        // Place of pixel 0's centre in the table; later pixels are whole samples further.
        let place = (axis.centre(0) - centre) / axis.pitch_m * per_pixel as f64 + self.middle[k] as f64;
        let first = place.floor();
        let t = place - first;
        let start = first as i64 - 1;
        // Pixels whose four samples lie within the table.
        let (n, m, length) = (axis.n as i64, per_pixel as i64, length as i64);
        let lowest = (-start).div_euclid(m) + i64::from((-start).rem_euclid(m) != 0);
        let highest = (length - 4 - start).div_euclid(m) + 1;
        let (lo, hi) = (lowest.clamp(0, n), highest.clamp(0, n));
        Along {
            pixels: lo as usize..(hi.max(lo)) as usize,
            start,
            per_pixel: m,
            weights: cubic(t),
        }
    }
}

/// One axis of a spot: sample `start + k·per_pixel` is the first of four for pixel k.
struct Along {
    pixels: std::ops::Range<usize>,
    start: i64,
    per_pixel: i64,
    weights: [f64; 4],
}

impl Along {
    fn sample(&self, pixel: usize) -> usize {
        (self.start + pixel as i64 * self.per_pixel) as usize
    }
}

/// Cubic B-spline weights of the four samples around a place `t` after the second.
fn cubic(t: f64) -> [f64; 4] {
    let s = 1.0 - t;
    let (t2, t3) = (t * t, t * t * t);
    [
        s * s * s / 6.0,
        2.0 / 3.0 - t2 + 0.5 * t3,
        2.0 / 3.0 - s * s + 0.5 * s * s * s,
        t3 / 6.0,
    ]
}

/// Samples to coefficients of the interpolating cubic B-spline (Unser, 1999, eq. 16–17), zero outside.
fn prefilter(line: &mut ndarray::ArrayViewMut1<f64>) {
    let pole = 3.0_f64.sqrt() - 2.0;
    let n = line.len();
    for k in 1..n {
        line[k] += pole * line[k - 1];
    }
    line[n - 1] *= -pole / (1.0 - pole * pole);
    for k in (0..n - 1).rev() {
        line[k] = pole * (line[k + 1] - line[k]);
    }
    line.mapv_inplace(|v| 6.0 * v);
}
