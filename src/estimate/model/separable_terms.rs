//! Separable terms: products of a profile along x and one along y, with first and second derivatives, stored only where non-zero.

use std::ops::Range;

use crate::estimate::dense_linalg::{axpy, combine, dot, weighted_dot};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::masked_pixels::Run;

/// Orders of the derivatives of i and of j, along x and along y, in each of the nine inner products of a pair.
const ALONG_X: [[usize; 2]; 9] = [[1, 1], [1, 0], [1, 0], [0, 1], [0, 0], [0, 0], [0, 1], [0, 0], [0, 0]];
const ALONG_Y: [[usize; 2]; 9] = [[0, 0], [0, 1], [0, 0], [1, 0], [1, 1], [1, 0], [0, 0], [0, 1], [0, 0]];

/// Separable terms in the bases, in the order they were pushed.
#[derive(Default)]
pub(crate) struct SeparableTerms {
    mx: usize,
    my: usize,
    /// (terms, 3, mx): f, f′, f″.
    x: Vec<f64>,
    y: Vec<f64>,
    /// Columns and rows outside which a term is zero.
    spans: Vec<[[usize; 2]; 2]>,
    /// f, f′, f″ at pixels along each axis, (terms, pixels); only at the lines of masked pixels.
    at: [Vec<[f64; 3]>; 2],
    lines: [usize; 2],
}

// Loops over arrays, not `map` and `from_fn`: a closure is not compiled for the instructions that its caller was dispatched to.
impl SeparableTerms {
    /// Removes all terms and reserves room for `count` in bases of (mx, my) columns.
    #[inline(always)]
    pub fn clear(&mut self, count: usize, mx: usize, my: usize) {
        (self.mx, self.my) = (mx, my);
        self.x.resize(count * 3 * mx, 0.0);
        self.y.resize(count * 3 * my, 0.0);
        self.spans.clear();
    }

    /// A term of a spot at `u`, relative widths `w`.
    #[inline(always)]
    pub fn push(&mut self, axes: [&Basis; 2], u: [f64; 2], w: [f64; 2], reach: f64, scratch: &mut [f64]) {
        let (i, mx, my) = (self.count(), self.mx, self.my);
        let x = &mut self.x[i * 3 * mx..(i + 1) * 3 * mx];
        let columns = axes[0].profile(u[0], w[0], reach, mx, scratch, x);
        let y = &mut self.y[i * 3 * my..(i + 1) * 3 * my];
        let rows = axes[1].profile(u[1], w[1], reach, my, scratch, y);
        // Whole vectors of four: padding holds zeros.
        let span = |r: Range<usize>, m: usize| [r.start & !3, r.end.next_multiple_of(4).min(m)];
        self.spans.push(match columns.is_empty() || rows.is_empty() {
            true => [[0; 2]; 2],
            false => [span(columns, mx), [rows.start, rows.end]],
        });
    }

    /// A term of given profiles without derivatives.
    #[inline(always)]
    pub fn push_profiles(&mut self, profiles: [&[f64]; 2]) {
        let (i, mx, my) = (self.count(), self.mx, self.my);
        let x = &mut self.x[i * 3 * mx..(i + 1) * 3 * mx];
        x.fill(0.0);
        x[..mx].copy_from_slice(&profiles[0][..mx]);
        let y = &mut self.y[i * 3 * my..(i + 1) * 3 * my];
        y.fill(0.0);
        y[..my].copy_from_slice(&profiles[1][..my]);
        self.spans.push([[0, mx], [0, my]]);
    }

    pub fn count(&self) -> usize {
        self.spans.len()
    }

    /// Numbers within all terms' spans together.
    pub fn footprint(&self) -> f64 {
        let area = |s: &[[usize; 2]; 2]| ((s[0][1] - s[0][0]) * (s[1][1] - s[1][0])) as f64;
        self.spans.iter().map(area).sum()
    }

    /// Profile `d` (0 to 2: f, f′, f″) of term `i` along x within its span.
    #[inline(always)]
    pub fn x(&self, i: usize, d: usize) -> &[f64] {
        let [lo, hi] = self.spans[i][0];
        let start = (3 * i + d) * self.mx;
        &self.x[start + lo..start + hi]
    }

    #[inline(always)]
    pub fn y(&self, i: usize, d: usize) -> &[f64] {
        let [lo, hi] = self.spans[i][1];
        let start = (3 * i + d) * self.my;
        &self.y[start + lo..start + hi]
    }

    /// f, f′, f″ of term `i` at a masked pixel, along x and along y.
    #[inline(always)]
    pub fn at(&self, i: usize, x: usize, y: usize) -> [[f64; 3]; 2] {
        [self.at[0][i * self.lines[0] + x], self.at[1][i * self.lines[1] + y]]
    }

    #[inline(always)]
    pub fn evaluate_lines(&mut self, axes: [&Basis; 2], lines: &[Vec<usize>; 2]) {
        for k in 0..2 {
            let n = if lines[k].is_empty() { 0 } else { axes[k].n };
            let mut at = std::mem::take(&mut self.at[k]);
            at.clear();
            at.resize(self.count() * n, [0.0; 3]);
            for i in 0..self.count() {
                let [lo, hi] = self.spans[i][k];
                let profile = |d: usize| if k == 0 { self.x(i, d) } else { self.y(i, d) };
                for &line in &lines[k] {
                    let out = &mut at[i * n + line];
                    if !axes[k].is_pixels {
                        let row = &axes[k].row(line)[lo..hi];
                        for d in 0..3 {
                            out[d] = dot(row, profile(d));
                        }
                    } else if (lo..hi).contains(&line) {
                        for d in 0..3 {
                            out[d] = profile(d)[line - lo];
                        }
                    }
                }
            }
            self.at[k] = at;
            self.lines[k] = n;
        }
    }

    /// Adds `scale`·f_y⁽ᵇ⁾⊗f_x⁽ᵃ⁾ of term `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn accumulate(&self, i: usize, a: usize, b: usize, scale: f64, matrix: &mut [f64]) {
        let [[x0, x1], [y0, _]] = self.spans[i];
        let fx = self.x(i, a);
        for (c, &w) in self.y(i, b).iter().enumerate() {
            let start = (y0 + c) * self.mx;
            axpy(scale * w, fx, &mut matrix[start + x0..start + x1]);
        }
    }

    /// Adds `f_y⊗(q0[0] f″_x + q0[1] f′_x) + f′_y⊗(q1[0] f′_x + q1[1] f_x) + q2 f″_y⊗f_x` of term `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn accumulate_second_derivative(
        &self,
        i: usize,
        q0: [f64; 2],
        q1: [f64; 2],
        q2: f64,
        scratch: &mut Vec<f64>,
        matrix: &mut [f64],
    ) {
        let [[x0, x1], [y0, _]] = self.spans[i];
        let m = x1 - x0;
        scratch.resize(scratch.len().max(3 * m), 0.0);
        let (s0, rest) = scratch.split_at_mut(m);
        let (s1, rest) = rest.split_at_mut(m);
        let s2 = &mut rest[..m];
        let (f, f1, f2) = (self.x(i, 0), self.x(i, 1), self.x(i, 2));
        for c in 0..m {
            s0[c] = q0[0] * f2[c] + q0[1] * f1[c];
            s1[c] = q1[0] * f1[c] + q1[1] * f[c];
            s2[c] = q2 * f[c];
        }
        let (g, g1, g2) = (self.y(i, 0), self.y(i, 1), self.y(i, 2));
        for c in 0..g.len() {
            let start = (y0 + c) * self.mx;
            let row = &mut matrix[start + x0..start + x1];
            for k in 0..m {
                row[k] += g[c] * s0[k] + g1[c] * s1[k] + g2[c] * s2[k];
            }
        }
    }

    /// Inner products of a matrix (my, mx) with f_y⊗f_x, f_y⊗f′_x and f′_y⊗f_x of term `i`.
    #[inline(always)]
    pub fn project(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        let [t, t1] = self.contract_y(i, [0, 1], matrix, scratch);
        [dot(t, self.x(i, 0)), dot(t, self.x(i, 1)), dot(t1, self.x(i, 0))]
    }

    /// The first value of [`Self::project`] alone.
    #[inline(always)]
    pub fn project_value(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> f64 {
        let [t] = self.contract_y(i, [0], matrix, scratch);
        dot(t, self.x(i, 0))
    }

    /// Inner products with the second derivatives: xx, xy, yy.
    #[inline(always)]
    pub fn project_second_derivatives(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        let [t, t1] = self.contract_y(i, [0, 1], matrix, scratch);
        let (xx, xy) = (dot(t, self.x(i, 2)), dot(t1, self.x(i, 1)));
        let [t2] = self.contract_y(i, [2], matrix, scratch);
        [xx, xy, dot(t2, self.x(i, 0))]
    }

    /// Rows of a matrix (my, mx) summed under profiles along y of term `i`, over its columns.
    #[inline(always)]
    fn contract_y<'a, const K: usize>(
        &self,
        i: usize,
        profiles: [usize; K],
        matrix: &[f64],
        scratch: &'a mut Vec<f64>,
    ) -> [&'a [f64]; K] {
        let [[x0, x1], [y0, _]] = self.spans[i];
        let m = x1 - x0;
        scratch.resize(scratch.len().max(K * m), 0.0);
        let weights = profiles.map(|d| self.y(i, d));
        if m > 0 {
            combine(weights, 1, &matrix[y0 * self.mx + x0..], self.mx, m, scratch);
        }
        let mut terms = scratch.chunks_exact(m.max(1));
        std::array::from_fn(|_| terms.next().unwrap_or_default())
    }

    #[inline(always)]
    fn overlap(&self, i: usize, j: usize) -> [[usize; 2]; 2] {
        let (p, q) = (&self.spans[i], &self.spans[j]);
        [0, 1].map(|k| [p[k][0].max(q[k][0]), p[k][1].min(q[k][1])])
    }

    /// Inner product of term `i`'s derivative, `a[0]` times along x and `a[1]` times along y, with term `j`'s under `weights`
    /// (my, mx), even where that is empty.
    #[inline(always)]
    pub fn inner_product(
        &self,
        i: usize,
        a: [usize; 2],
        j: usize,
        b: [usize; 2],
        weights: &[f64],
        scratch: &mut Vec<f64>,
    ) -> f64 {
        let [[x0, x1], [y0, y1]] = self.overlap(i, j);
        if x0 >= x1 || y0 >= y1 {
            return 0.0;
        }
        let (mx, my) = (self.mx, self.my);
        let x = |i: usize, d: usize| &self.x[(3 * i + d) * mx + x0..(3 * i + d) * mx + x1];
        let y = |i: usize, d: usize| &self.y[(3 * i + d) * my + y0..(3 * i + d) * my + y1];
        if weights.is_empty() {
            return dot(x(i, a[0]), x(j, b[0])) * dot(y(i, a[1]), y(j, b[1]));
        }
        scratch.clear();
        scratch.resize(x1 - x0, 0.0);
        for (c, (v, w)) in y(i, a[1]).iter().zip(y(j, b[1])).enumerate() {
            let start = (y0 + c) * mx;
            axpy(v * w, &weights[start + x0..start + x1], scratch);
        }
        weighted_dot(scratch, x(i, a[0]), x(j, b[0]))
    }

    /// Inner products along x and along y of term `i`'s f, f′ and f″ with term `j`'s f and f′; `None` where they share nothing.
    #[inline(always)]
    pub fn axis_inner_products(&self, i: usize, j: usize) -> Option<[[[f64; 2]; 3]; 2]> {
        let [[x0, x1], [y0, y1]] = self.overlap(i, j);
        if x0 >= x1 || y0 >= y1 {
            return None;
        }
        let (mx, my) = (self.mx, self.my);
        let x = |i: usize, d: usize| &self.x[(3 * i + d) * mx + x0..(3 * i + d) * mx + x1];
        let y = |i: usize, d: usize| &self.y[(3 * i + d) * my + y0..(3 * i + d) * my + y1];
        let mut axis_inner_products = [[[0.0; 2]; 3]; 2];
        for a in 0..3 {
            for b in 0..2 {
                axis_inner_products[0][a][b] = dot(x(i, a), x(j, b));
                axis_inner_products[1][a][b] = dot(y(i, a), y(j, b));
            }
        }
        Some(axis_inner_products)
    }

    /// Inner products of (f′_x f_y, f_x f′_y, f_x f_y) of term `i` with those of term `j`, 3 × 3 row-major.
    #[inline(always)]
    pub fn gram_block(&self, i: usize, j: usize, weights: &[f64], scratch: &mut Vec<f64>) -> [f64; 9] {
        let [[x0, x1], [y0, y1]] = self.overlap(i, j);
        if x0 >= x1 || y0 >= y1 {
            return [0.0; 9];
        }
        let mut out = [0.0; 9];
        let (mx, my) = (self.mx, self.my);
        let x = |i: usize, d: usize| &self.x[(3 * i + d) * mx + x0..(3 * i + d) * mx + x1];
        let y = |i: usize, d: usize| &self.y[(3 * i + d) * my + y0..(3 * i + d) * my + y1];
        if weights.is_empty() {
            let (mut tx, mut ty) = ([0.0; 4], [0.0; 4]);
            for k in 0..4 {
                tx[k] = dot(x(i, k / 2), x(j, k % 2));
                ty[k] = dot(y(i, k / 2), y(j, k % 2));
            }
            for k in 0..9 {
                let ([a, b], [c, d]) = (ALONG_X[k], ALONG_Y[k]);
                out[k] = tx[2 * a + b] * ty[2 * c + d];
            }
            return out;
        }
        let m = x1 - x0;
        scratch.clear();
        scratch.resize(4 * m, 0.0);
        let (t00, rest) = scratch.split_at_mut(m);
        let (t01, rest) = rest.split_at_mut(m);
        let (t10, t11) = rest.split_at_mut(m);
        for c in 0..y1 - y0 {
            let start = (y0 + c) * mx;
            let w = &weights[start + x0..start + x1];
            let [a, a1, b, b1] = [y(i, 0)[c], y(i, 1)[c], y(j, 0)[c], y(j, 1)[c]];
            let v = [a * b, a * b1, a1 * b, a1 * b1];
            for k in 0..m {
                t00[k] += v[0] * w[k];
                t01[k] += v[1] * w[k];
                t10[k] += v[2] * w[k];
                t11[k] += v[3] * w[k];
            }
        }
        let t: [&[f64]; 4] = [t00, t01, t10, t11];
        for k in 0..9 {
            let ([a, b], [c, d]) = (ALONG_X[k], ALONG_Y[k]);
            out[k] = weighted_dot(t[2 * c + d], x(i, a), x(j, b));
        }
        out
    }

    /// [`SeparableTerms::gram_block`] over the pixels of `runs` alone, each run a difference of running sums along x.
    #[inline(always)]
    pub fn gram_block_over_runs(&self, i: usize, j: usize, runs: &[Run], scratch: &mut Vec<f64>) -> [f64; 9] {
        let [[x0, x1], [y0, y1]] = self.overlap(i, j);
        if x0 >= x1 || y0 >= y1 {
            return [0.0; 9];
        }
        let [nx, ny] = self.lines;
        let (xi, xj) = (&self.at[0][i * nx..(i + 1) * nx], &self.at[0][j * nx..(j + 1) * nx]);
        let (yi, yj) = (&self.at[1][i * ny..(i + 1) * ny], &self.at[1][j * ny..(j + 1) * ny]);
        scratch.resize(scratch.len().max(4 * (nx + 1)), 0.0);
        let sums = scratch.as_chunks_mut::<4>().0;
        let mut sum = [0.0; 4];
        for x in 0..nx {
            sums[x] = sum;
            for k in 0..4 {
                sum[k] += xi[x][k / 2] * xj[x][k % 2];
            }
        }
        sums[nx] = sum;
        let mut whole = [[0.0; 4]; 4];
        for run in runs {
            let (from, to) = (sums[run.x.start], sums[run.x.end]);
            for k in 0..4 {
                let along_y = yi[run.y][k / 2] * yj[run.y][k % 2];
                for l in 0..4 {
                    whole[k][l] += along_y * (to[l] - from[l]);
                }
            }
        }
        let mut out = [0.0; 9];
        for k in 0..9 {
            let ([a, b], [c, d]) = (ALONG_X[k], ALONG_Y[k]);
            out[k] = whole[2 * c + d][2 * a + b];
        }
        out
    }
}
