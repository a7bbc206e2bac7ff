//! One axis of the frame in an orthonormal basis (left singular vectors) that spans every spot the axis can see.
//!
//! A blurred frame has far fewer degrees of freedom than pixels: the kernels of all positions span, to any given
//! accuracy, a space of m ≪ n dimensions when σ is wider than a pixel. Fitting there is lossless for white noise
//! and costs m² instead of n²; the rest of the frame is pure noise and measures it without a model.

use std::ops::Range;

use faer::Mat;

use crate::estimate::model::psf_table;
use crate::optics::Axis;

/// How far outside the sensor a centre may lie, σ. With less, an emitter just outside biases the others; farther out 2 % of its light is
/// left on the sensor, and any faint tail would be explained by an emitter there.
const MARGIN: f64 = 2.0;
const KNOTS_PER_SIGMA: f64 = 16.0;
/// Axes wider than this many σ are fitted in pixels: spots are small against them and the basis would be too large (the SVD grows with the
/// third power).
const WIDEST: f64 = 120.0;
/// Relative widths that the basis must span too, so that a wrong σ can be fitted.
const WIDTHS: [f64; 5] = [0.85, 0.93, 1.0, 1.08, 1.18];

/// An axis in units of σ, with its basis.
#[derive(Clone)]
pub(crate) struct Basis {
    pub n: usize,
    /// Pixel edges, σ.
    pub edges: Vec<f64>,
    /// Doubles between rows of `u`, a multiple of 4; also the length of a profile.
    pub stride: usize,
    /// Pixels to coefficients, (n, stride) row-major; unused columns are zero.
    u: Vec<f64>,
    /// Its transpose, (stride, width).
    transposed: Vec<f64>,
    pub is_pixels: bool,
    /// `tail[m]`: largest norm that a spot of width σ leaves outside the first m columns.
    tail: Vec<f64>,
    /// f, f′, f″ at the knots, (knots, 3, stride).
    table: Vec<f64>,
    first_knot: f64,
}

impl Basis {
    pub fn new(axis: &Axis, sigma: f64) -> Self {
        let n = axis.n;
        let edges: Vec<f64> = (0..=n).map(|k| axis.edge(k) / sigma).collect();
        let extent = edges[n] - edges[0] + 2.0 * MARGIN;
        let mut basis = Self::pixels(axis, sigma);
        if extent <= WIDEST {
            basis.decompose(extent);
        }
        basis
    }

    /// The axis in its pixels: every spot touches few of them, and each may have a weight of its own.
    pub fn pixels(axis: &Axis, sigma: f64) -> Self {
        let n = axis.n;
        let edges: Vec<f64> = (0..=n).map(|k| axis.edge(k) / sigma).collect();
        let mut basis = Self {
            n,
            stride: n.next_multiple_of(4),
            u: Vec::new(),
            transposed: Vec::new(),
            is_pixels: true,
            tail: Vec::new(),
            table: Vec::new(),
            first_knot: edges[0] - MARGIN,
            edges,
        };
        basis.fill_identity();
        basis.transpose();
        basis
    }

    pub fn min_position(&self) -> f64 {
        self.edges[0] - MARGIN
    }

    pub fn max_position(&self) -> f64 {
        self.edges[self.n] + MARGIN
    }

    pub fn pitch(&self) -> f64 {
        self.edges[1] - self.edges[0]
    }

    /// Columns in use.
    pub fn columns(&self) -> usize {
        if self.is_pixels { self.n } else { self.tail.len() - 1 }
    }

    /// Basis row of pixel `k`.
    #[inline(always)]
    pub fn row(&self, k: usize) -> &[f64] {
        &self.u[k * self.stride..(k + 1) * self.stride]
    }

    /// All rows, (n, stride).
    #[inline(always)]
    pub fn rows(&self) -> &[f64] {
        &self.u
    }

    /// Basis columns from pixel `first` on, with [`Basis::width`] doubles between them; zero beyond the last pixel.
    #[inline(always)]
    pub fn columns_from(&self, first: usize) -> &[f64] {
        &self.transposed[first..]
    }

    pub fn width(&self) -> usize {
        self.n + 4
    }

    fn transpose(&mut self) {
        let width = self.width();
        self.transposed = vec![0.0; self.stride * width];
        for (k, row) in self.u.chunks_exact(self.stride).enumerate() {
            for (c, value) in row.iter().enumerate() {
                self.transposed[c * width + k] = *value;
            }
        }
    }

    /// Largest norm that a spot leaves outside the first `m` columns.
    pub fn tail(&self, m: usize) -> f64 {
        self.tail.get(m).copied().unwrap_or(0.0)
    }

    /// Fewest columns that leave at most `tolerance` of a unit spot outside.
    pub fn rank(&self, tolerance: f64) -> usize {
        if self.is_pixels {
            return self.n;
        }
        self.tail.iter().position(|&t| t <= tolerance).unwrap_or(self.n).max(1)
    }

    fn fill_identity(&mut self) {
        self.u = vec![0.0; self.n * self.stride];
        for k in 0..self.n {
            self.u[k * self.stride + k] = 1.0;
        }
    }

    fn decompose(&mut self, extent: f64) {
        let n = self.n;
        let samples = (extent * 4.0).ceil() as usize + 1;
        let at = |j: usize| self.first_knot + extent * j as f64 / (samples - 1) as f64;
        let mut kernels = Mat::<f64>::zeros(n, samples * WIDTHS.len() + 2);
        let (mut f, mut f1, mut f2) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        for (b, w) in WIDTHS.into_iter().enumerate() {
            for j in 0..samples {
                for k in psf_table::profile(&self.edges, at(j), w, psf_table::REACH, &mut f, &mut f1, &mut f2) {
                    kernels[(k, b * samples + j)] = f[k];
                }
            }
        }
        // Background profiles: a constant and a slope over the sensor.
        let spot_norm = (self.pitch() / (2.0 * std::f64::consts::PI.sqrt())).sqrt().min(1.0);
        let half = 0.5 * n as f64;
        for k in 0..n {
            let s = (k as f64 + 0.5 - half) / half;
            kernels[(k, samples * WIDTHS.len())] = spot_norm / (n as f64).sqrt();
            kernels[(k, samples * WIDTHS.len() + 1)] = spot_norm * s / (n as f64 / 3.0).sqrt();
        }
        let svd = kernels.thin_svd().expect("a finite matrix has an SVD");
        let columns = svd.U();
        let rank = columns.ncols();
        let mut left = vec![0.0f64; kernels.ncols()];
        let mut coefficients = vec![vec![0.0; rank]; kernels.ncols()];
        for (j, row) in coefficients.iter_mut().enumerate() {
            for (c, value) in row.iter_mut().enumerate() {
                *value = (0..n).map(|k| columns[(k, c)] * kernels[(k, j)]).sum();
            }
        }
        self.tail = vec![0.0; rank + 1];
        for m in (0..rank).rev() {
            for (l, row) in left.iter_mut().zip(&coefficients) {
                *l += row[m] * row[m];
            }
            self.tail[m] = left.iter().fold(0.0, |a: f64, &l| a.max(l)).sqrt();
        }
        // Columns below rounding are dropped.
        let kept = self.tail.iter().position(|&t| t < 1e-13).unwrap_or(rank).max(1);
        self.stride = kept.next_multiple_of(4);
        self.u = vec![0.0; n * self.stride];
        for k in 0..n {
            for c in 0..kept.min(rank) {
                self.u[k * self.stride + c] = columns[(k, c)];
            }
        }
        self.transpose();
        self.tail.truncate(kept + 1);
        self.is_pixels = false;

        let knots = (extent * KNOTS_PER_SIGMA).ceil() as usize + 1;
        let stride = self.stride;
        let mut table = vec![0.0; knots * 3 * stride];
        let mut scratch = vec![0.0; 3 * n];
        for (k, row) in table.chunks_exact_mut(3 * stride).enumerate() {
            let u = self.first_knot + k as f64 / KNOTS_PER_SIGMA;
            self.profile_direct(u, 1.0, psf_table::REACH, stride, &mut scratch, row);
        }
        self.table = table;
    }

    /// f, f′, f″ of a spot of relative width `w` at `u`, as far out as `reach` widths, in the first `m` columns; `out` is
    /// (3, m), `scratch` 3 n. Returns the columns that are non-zero.
    #[inline(always)]
    pub fn profile(&self, u: f64, w: f64, reach: f64, m: usize, scratch: &mut [f64], out: &mut [f64]) -> Range<usize> {
        if w != 1.0 || self.table.is_empty() {
            return self.profile_direct(u, w, reach, m, scratch, out);
        }
        // Quintic Hermite interpolation: the error is h⁶/46080·f⁽⁶⁾, 2e-11 of the spot.
        let position = (u - self.first_knot) * KNOTS_PER_SIGMA;
        let knots = self.table.len() / (3 * self.stride);
        let k = (position.floor().max(0.0) as usize).min(knots - 2);
        let t = position - k as f64;
        let h = 1.0 / KNOTS_PER_SIGMA;
        let (t2, t3) = (t * t, t * t * t);
        let value = [
            1.0 - t3 * (10.0 - t * (15.0 - 6.0 * t)),
            h * (t - t3 * (6.0 - t * (8.0 - 3.0 * t))),
            0.5 * h * h * t2 * (1.0 - t * (3.0 - t * (3.0 - t))),
            t3 * (10.0 - t * (15.0 - 6.0 * t)),
            h * t3 * (-4.0 + t * (7.0 - 3.0 * t)),
            0.5 * h * h * t3 * (1.0 - t * (2.0 - t)),
        ];
        let rise = t2 * (30.0 - t * (60.0 - 30.0 * t)) / h;
        let slope = [
            -rise,
            1.0 - t2 * (18.0 - t * (32.0 - 15.0 * t)),
            0.5 * h * t * (2.0 - t * (9.0 - t * (12.0 - 5.0 * t))),
            rise,
            t2 * (-12.0 + t * (28.0 - 15.0 * t)),
            0.5 * h * t2 * (3.0 - t * (8.0 - 5.0 * t)),
        ];
        let second = t * (60.0 - t * (180.0 - 120.0 * t)) / (h * h);
        let curvature = [
            -second,
            -t * (36.0 - t * (96.0 - 60.0 * t)) / h,
            0.5 * (2.0 - t * (18.0 - t * (36.0 - 20.0 * t))),
            second,
            t * (-24.0 + t * (84.0 - 60.0 * t)) / h,
            0.5 * t * (6.0 - t * (24.0 - 20.0 * t)),
        ];
        let s = self.stride;
        let rows = &self.table[k * 3 * s..(k + 2) * 3 * s];
        let (a0, a1, a2) = (&rows[..m], &rows[s..s + m], &rows[2 * s..2 * s + m]);
        let (b0, b1, b2) = (
            &rows[3 * s..3 * s + m],
            &rows[4 * s..4 * s + m],
            &rows[5 * s..5 * s + m],
        );
        let (f, rest) = out.split_at_mut(m);
        let (f1, f2) = rest.split_at_mut(m);
        let f2 = &mut f2[..m];
        for c in 0..m {
            let q = [a0[c], a1[c], a2[c], b0[c], b1[c], b2[c]];
            let mut sum = [0.0; 3];
            for j in 0..6 {
                sum[0] += value[j] * q[j];
                sum[1] += slope[j] * q[j];
                sum[2] += curvature[j] * q[j];
            }
            (f[c], f1[c], f2[c]) = (sum[0], sum[1], sum[2]);
        }
        0..m
    }

    #[inline(always)]
    fn profile_direct(
        &self,
        u: f64,
        w: f64,
        reach: f64,
        m: usize,
        scratch: &mut [f64],
        out: &mut [f64],
    ) -> Range<usize> {
        let n = self.n;
        let (f, rest) = scratch.split_at_mut(n);
        let (f1, f2) = rest.split_at_mut(n);
        let range = psf_table::profile(&self.edges, u, w, reach, f, f1, &mut f2[..n]);
        out[..3 * m].fill(0.0);
        let (o, rest) = out.split_at_mut(m);
        let (o1, o2) = rest.split_at_mut(m);
        if self.is_pixels {
            o[range.clone()].copy_from_slice(&f[range.clone()]);
            o1[range.clone()].copy_from_slice(&f1[range.clone()]);
            o2[range.clone()].copy_from_slice(&f2[range.clone()]);
            return range;
        }
        for k in range {
            let row = &self.row(k)[..m];
            for c in 0..m {
                o[c] += f[k] * row[c];
                o1[c] += f1[k] * row[c];
                o2[c] += f2[k] * row[c];
            }
        }
        0..m
    }

    /// Coefficients of a profile over the pixels.
    pub fn compress(&self, pixels: impl Iterator<Item = f64>, out: &mut [f64]) {
        out.fill(0.0);
        for (k, value) in pixels.enumerate() {
            for (o, u) in out.iter_mut().zip(self.row(k)) {
                *o += value * u;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_agrees_with_direct_evaluation() {
        let basis = Basis::new(&Axis::centred(60, 0.03), 0.008);
        let m = basis.stride;
        let (mut scratch, mut a, mut b) = (vec![0.0; 180], vec![0.0; 3 * m], vec![0.0; 3 * m]);
        for k in 0..200 {
            let u = basis.min_position() + (basis.max_position() - basis.min_position()) * (k as f64 + 0.37) / 200.0;
            basis.profile(u, 1.0, psf_table::REACH, m, &mut scratch, &mut a);
            basis.profile_direct(u, 1.0, psf_table::REACH, m, &mut scratch, &mut b);
            for c in 0..m {
                // Interpolation errors h⁶, h⁵, h⁴ with h = 1/16 and their small constants.
                assert!((a[c] - b[c]).abs() < 1e-10);
                assert!((a[m + c] - b[m + c]).abs() < 1e-8);
                assert!((a[2 * m + c] - b[2 * m + c]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn few_columns_hold_a_wide_spot_and_all_pixels_a_narrow_one() {
        let wide = Basis::new(&Axis::centred(64, 0.03), 0.008);
        assert!(wide.rank(1e-8) < 24, "{}", wide.rank(1e-8));
        let narrow = Basis::new(&Axis::centred(10, 0.03), 0.0005);
        assert_eq!(narrow.rank(1e-6), 10);
    }
}
