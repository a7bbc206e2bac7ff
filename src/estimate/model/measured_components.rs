//! Components of a measured PSF: each a patch of pixels with first and second derivatives, summed over the PSF's separable terms.
//!
//! With K terms a pair of sources has K² pairs of products, but its patches overlap in a few hundred pixels: sums over pixels cost less from
//! K = 3 on. Only in the pixel bases, where each pixel has a weight (zero where it is masked).

use std::sync::Arc;

use crate::estimate::dense_linalg::axpy;
use crate::estimate::model::svd_basis::Basis;
use crate::optics::spot::{Profile, SpotShape};

/// A measured PSF in the units of a fit.
#[derive(Clone)]
pub(crate) struct MeasuredShape {
    shape: Arc<SpotShape>,
    /// The unit of length, m.
    sigma_m: f64,
}

/// f, f_x, f_y, f_xx, f_xy, f_yy.
const ARRAYS: usize = 6;

/// Index of the array that holds a derivative, by its orders along x and y.
const fn array(a: usize, b: usize) -> usize {
    match (a, b) {
        (0, 0) => 0,
        (1, 0) => 1,
        (0, 1) => 2,
        (2, 0) => 3,
        (1, 1) => 4,
        _ => 5,
    }
}

/// Patches in the order they were pushed.
#[derive(Default)]
pub(crate) struct MeasuredComponents {
    mx: usize,
    /// Columns and rows that a component covers.
    spans: Vec<[[usize; 2]; 2]>,
    /// Where each component's arrays begin; each is (rows, columns), and there are six, or one without derivatives.
    starts: Vec<usize>,
    values: Vec<f64>,
    /// Profiles of one term along an axis: the values, first and second derivatives.
    profiles: [[Vec<f64>; 3]; 2],
}

impl MeasuredShape {
    pub fn new(shape: Arc<SpotShape>, sigma_m: f64) -> Self {
        Self { shape, sigma_m }
    }

    /// Separable terms.
    pub fn terms(&self) -> usize {
        self.shape.terms()
    }

    /// Pixels that a spot at `u` reaches, moved by as much as `beyond` to either side.
    fn span(&self, basis: &Basis, u: f64, beyond: f64) -> [usize; 2] {
        let radius = self.shape.radius_m() / self.sigma_m + beyond;
        let pixel = |edge: f64| ((edge - basis.edges[0]) / basis.pitch()).clamp(0.0, basis.n as f64);
        let [first, last] = [pixel(u - radius).floor() as usize, pixel(u + radius).ceil() as usize];
        [first, last.max(first)]
    }

    /// Pixel fractions of a profile at `u` and their derivatives in u.
    fn collect(&self, profile: &Profile, basis: &Basis, u: f64, [first, last]: [usize; 2], out: &mut [Vec<f64>; 3]) {
        let s = self.sigma_m;
        let value = |edge: f64| profile.value((edge - u) * s);
        for o in &mut *out {
            o.clear();
        }
        if first >= last {
            return;
        }
        let mut low = value(basis.edges[first]);
        for k in first..last {
            let high = value(basis.edges[k + 1]);
            out[0].push(high.cumulative - low.cumulative);
            out[1].push(s * (low.density - high.density));
            out[2].push(s * s * (high.slope - low.slope));
            low = high;
        }
    }
}

impl MeasuredComponents {
    /// Removes all components; the pixel bases have `mx` numbers a row.
    pub fn clear(&mut self, mx: usize) {
        self.mx = mx;
        self.spans.clear();
        self.starts.clear();
        self.values.clear();
    }

    /// A spot of unit energy at `u`, σ, smeared over `displacement`, σ: by its parts and the shares of the light.
    pub fn push(
        &mut self,
        shape: &MeasuredShape,
        axes: [&Basis; 2],
        u: [f64; 2],
        displacement: [f64; 2],
        parts: &[(f64, f64)],
    ) {
        let spans = [0, 1].map(|k| shape.span(axes[k], u[k], 0.5 * displacement[k].abs()));
        let [columns, rows] = spans.map(|[low, high]| high - low);
        let (start, area) = (self.values.len(), columns * rows);
        self.spans.push(spans);
        self.starts.push(start);
        self.values.resize(start + ARRAYS * area, 0.0);
        let mut profiles = std::mem::take(&mut self.profiles);
        for (part, of) in parts {
            let u = [0, 1].map(|k| u[k] + part * displacement[k]);
            let [sx, sy] = u.map(|v| v * shape.sigma_m);
            for (k, (w, du, dv)) in shape.shape.weights_at(sx, sy).enumerate() {
                let (w, du, dv) = (of * w, of * du * shape.sigma_m, of * dv * shape.sigma_m);
                let [along_x, along_y] = &mut profiles;
                shape.collect(shape.shape.x_profile(k), axes[0], u[0], spans[0], along_x);
                shape.collect(shape.shape.y_profile(k), axes[1], u[1], spans[1], along_y);
                let [a, a1, a2] = &*along_x;
                for row in 0..rows {
                    let [b, b1, b2] = [along_y[0][row], along_y[1][row], along_y[2][row]];
                    let mut add = |array: usize, factors: [f64; 3]| {
                        let at = start + array * area + row * columns;
                        let out = &mut self.values[at..at + columns];
                        for (factor, profile) in factors.into_iter().zip([a, a1, a2]) {
                            if factor != 0.0 {
                                axpy(factor, profile, out);
                            }
                        }
                    };
                    add(0, [w * b, 0.0, 0.0]);
                    add(1, [du * b, w * b, 0.0]);
                    add(2, [w * b1 + dv * b, 0.0, 0.0]);
                    // The weights' second derivatives are those of the field: far below the spot's.
                    add(3, [0.0, 2.0 * du * b, w * b]);
                    add(4, [du * b1, w * b1 + dv * b, 0.0]);
                    add(5, [w * b2 + 2.0 * dv * b1, 0.0, 0.0]);
                }
            }
        }
        self.profiles = profiles;
    }

    /// A component of given profiles over all pixels, without derivatives.
    pub fn push_profiles(&mut self, axes: [&Basis; 2], profiles: [&[f64]; 2]) {
        let [nx, ny] = axes.map(|b| b.n);
        self.spans.push([[0, nx], [0, ny]]);
        self.starts.push(self.values.len());
        for y in &profiles[1][..ny] {
            self.values.extend(profiles[0][..nx].iter().map(|x| x * y));
        }
    }

    /// Numbers within all spans together.
    pub fn footprint(&self) -> f64 {
        let area = |s: &[[usize; 2]; 2]| ((s[0][1] - s[0][0]) * (s[1][1] - s[1][0])) as f64;
        self.spans.iter().map(area).sum()
    }

    /// A row of the array of component `i`'s derivative; `None` where it has none.
    #[inline(always)]
    fn row(&self, i: usize, array: usize, y: usize) -> Option<&[f64]> {
        let [[x0, x1], [y0, y1]] = self.spans[i];
        let columns = x1 - x0;
        let start = self.starts[i] + (array * (y1 - y0) + y - y0) * columns;
        let end = self.starts.get(i + 1).copied().unwrap_or(self.values.len());
        (start + columns <= end).then(|| &self.values[start..start + columns])
    }

    /// Adds `scale` times the derivative of orders `a` and `b` along x and y of component `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn accumulate(&self, i: usize, a: usize, b: usize, scale: f64, matrix: &mut [f64]) {
        let [[x0, x1], [y0, y1]] = self.spans[i];
        for y in y0..y1 {
            if let Some(row) = self.row(i, array(a, b), y) {
                axpy(scale, row, &mut matrix[y * self.mx + x0..y * self.mx + x1]);
            }
        }
    }

    /// Inner products of a matrix (my, mx) with derivatives of component `i`.
    #[inline(always)]
    pub fn project<const N: usize>(&self, i: usize, derivatives: [[usize; 2]; N], matrix: &[f64]) -> [f64; N] {
        let [[x0, x1], [y0, y1]] = self.spans[i];
        let mut sum = [0.0; N];
        for y in y0..y1 {
            let values = &matrix[y * self.mx + x0..y * self.mx + x1];
            for (s, [a, b]) in sum.iter_mut().zip(derivatives) {
                if let Some(row) = self.row(i, array(a, b), y) {
                    *s += dot(row, values);
                }
            }
        }
        sum
    }

    /// Inner product of a derivative of component `i` with one of component `j` under `weights` (my, mx), or none where that is empty.
    #[inline(always)]
    pub fn inner_product(&self, i: usize, a: [usize; 2], j: usize, b: [usize; 2], weights: &[f64]) -> f64 {
        let [[x0, x1], [y0, y1]] = self.overlap(i, j);
        let (mut sum, columns) = (0.0, x1.saturating_sub(x0));
        for y in y0..if columns > 0 { y1 } else { y0 } {
            let rows = (self.row(i, array(a[0], a[1]), y), self.row(j, array(b[0], b[1]), y));
            if let (Some(p), Some(q)) = rows {
                let (p, q) = (&p[x0 - self.spans[i][0][0]..], &q[x0 - self.spans[j][0][0]..]);
                sum += if weights.is_empty() {
                    dot(&p[..columns], &q[..columns])
                } else {
                    triple(
                        &weights[y * self.mx + x0..y * self.mx + x1],
                        &p[..columns],
                        &q[..columns],
                    )
                };
            }
        }
        sum
    }

    /// Inner products of (f_x, f_y, f) of component `i` with those of component `j`, 3 × 3 row-major.
    #[inline(always)]
    pub fn gram_block(&self, i: usize, j: usize, weights: &[f64]) -> [f64; 9] {
        const ORDERS: [[usize; 2]; 3] = [[1, 0], [0, 1], [0, 0]];
        let mut out = [0.0; 9];
        for (r, a) in ORDERS.into_iter().enumerate() {
            for (c, b) in ORDERS.into_iter().enumerate() {
                // A component with itself is symmetric.
                out[3 * r + c] = match i == j && c < r {
                    true => out[3 * c + r],
                    false => self.inner_product(i, a, j, b, weights),
                };
            }
        }
        out
    }

    #[inline(always)]
    fn overlap(&self, i: usize, j: usize) -> [[usize; 2]; 2] {
        let (p, q) = (&self.spans[i], &self.spans[j]);
        [0, 1].map(|k| [p[k][0].max(q[k][0]), p[k][1].min(q[k][1])])
    }
}

/// Σ a b; any length.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 4];
    let (ca, cb) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = ca.remainder().iter().zip(cb.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in ca.zip(cb) {
        for l in 0..4 {
            lanes[l] += x[l] * y[l];
        }
    }
    rest + (lanes[0] + lanes[2]) + (lanes[1] + lanes[3])
}

/// Σ w a b; any length.
#[inline(always)]
fn triple(w: &[f64], a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 4];
    let (cw, ca, cb) = (w.chunks_exact(4), a.chunks_exact(4), b.chunks_exact(4));
    let rest = cw.remainder().iter().zip(ca.remainder()).zip(cb.remainder());
    let rest: f64 = rest.map(|((w, x), y)| w * x * y).sum();
    for ((w, x), y) in cw.zip(ca).zip(cb) {
        for l in 0..4 {
            lanes[l] += w[l] * x[l] * y[l];
        }
    }
    rest + (lanes[0] + lanes[2]) + (lanes[1] + lanes[3])
}
