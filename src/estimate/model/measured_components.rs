//! Components of a measured PSF: each a patch of pixels with first and second derivatives, summed over the PSF's separable terms.
//!
//! With K terms a pair of sources has K² pairs of products, but its patches overlap in a few hundred pixels: sums over pixels cost less from
//! K = 3 on. Only in the pixel bases, where each pixel has a weight (zero where it is masked).
//!
//! A lens's rings and tails reach far: 50 pixels across where a core of 15 says all of where the spot is. The predicted light and its gradient
//! are of the whole; what only shapes steps and covariances, of the core: second derivatives, and sources' products with each other.

use std::sync::Arc;

use crate::estimate::dense_linalg::{add_products, axpy, combine};
use crate::estimate::model::measured_terms::{MeasuredTerms, Part, Span, size};
use crate::estimate::model::patch_pool::{Patch, PatchPool, Place};
use crate::estimate::model::svd_basis::Basis;
use crate::optics::spot::SpotShape;

/// Share of what a spot says of its position and energy that lies outside its core: standard deviations are too large by half of it.
pub(super) const OUTSIDE_CORE: f64 = 1e-3;

/// A measured PSF in the units of a fit.
#[derive(Clone)]
pub(crate) struct MeasuredShape {
    shape: Arc<SpotShape>,
    /// The unit of length, m.
    sigma_m: f64,
    /// Where the bases' origin is on the sensor, over which the spot varies, m.
    pub origin_m: [f64; 2],
    /// Half-widths of the whole spot and of its core, σ.
    pub(super) radii: [f64; 2],
}

/// Orders along x and y of three derivatives.
pub(crate) type Orders = [[usize; 2]; 3];

/// f, f_y, f_x of the whole; f_xx, f_xy, f_yy of the core.
const EACH: usize = 3;

/// Index of the array that holds a derivative, by its orders along x and y.
const fn array(a: usize, b: usize) -> usize {
    match (a, b) {
        (0, 0) => 0,
        (0, 1) => 1,
        (1, 0) => 2,
        (2, 0) => 3,
        (1, 1) => 4,
        _ => 5,
    }
}

/// An array that covers the core alone.
const ARRAY_OF_CORE: usize = EACH;

/// Components in the order they were pushed.
#[derive(Default)]
pub(crate) struct MeasuredComponents {
    mx: usize,
    pool: PatchPool,
    /// The patch of each.
    patches: Vec<usize>,
    terms: MeasuredTerms,
    parts: Vec<Part>,
}

impl MeasuredShape {
    pub fn new(shape: Arc<SpotShape>, sigma_m: f64) -> Self {
        let radii = [shape.radius_m(), shape.core_radius_m(OUTSIDE_CORE)];
        Self {
            radii: radii.map(|r| r / sigma_m),
            shape,
            sigma_m,
            origin_m: [0.0; 2],
        }
    }

    /// The spot error farther out than is known of the shape, and from where it counts, σ.
    pub fn beyond(&self) -> Option<(f64, f64)> {
        self.shape
            .beyond()
            .map(|beyond| (beyond.error, beyond.from_m / self.sigma_m))
    }

    /// Separable terms.
    pub fn terms(&self) -> usize {
        self.shape.terms()
    }

    /// Pixels within `radius` of `u`.
    fn span(basis: &Basis, u: f64, radius: f64) -> [usize; 2] {
        let pixel = |edge: f64| ((edge - basis.edges[0]) / basis.pitch()).clamp(0.0, basis.n as f64);
        let [first, last] = [pixel(u - radius).floor() as usize, pixel(u + radius).ceil() as usize];
        [first, last.max(first)]
    }

    /// The same in whole vectors of four; the last may be beyond the sensor.
    fn wide_span(basis: &Basis, u: f64, radius: f64) -> [usize; 2] {
        let [first, last] = Self::span(basis, u, radius);
        [first & !3, last.next_multiple_of(4)]
    }
}

impl MeasuredComponents {
    /// Removes all components; the pixel bases have `mx` numbers a row.
    pub fn clear(&mut self, mx: usize) {
        self.mx = mx;
        self.patches.clear();
        self.pool.begin_model();
    }

    /// A spot of unit energy at `u`, σ, smeared over `displacement`, σ: by its parts and the shares of the light.
    #[inline(always)]
    pub fn push(
        &mut self,
        shape: &MeasuredShape,
        axes: [&Basis; 2],
        u: [f64; 2],
        displacement: [f64; 2],
        parts: &[(f64, f64)],
    ) {
        let spans = shape.radii.map(|radius| {
            let reach = |k: usize| radius + 0.5 * displacement[k].abs();
            [
                MeasuredShape::wide_span(axes[0], u[0], reach(0)),
                MeasuredShape::span(axes[1], u[1], reach(1)),
            ]
        });
        let place = Place {
            u,
            displacement,
            parts: parts.to_vec(),
            origin_m: shape.origin_m,
        };
        if let Some(index) = self.pool.find(&place) {
            self.patches.push(index);
            return;
        }
        let (index, values) = self.pool.add(Some(place), spans, [EACH; 2]);
        self.patches.push(index);
        let [whole, core] = spans;
        let ([columns, rows], [core_columns, core_rows]) = (size(whole), size(core));
        if columns * rows == 0 {
            return;
        }
        self.parts.clear();
        for (part, share) in parts {
            self.parts.push(Part {
                u: [u[0] + part * displacement[0], u[1] + part * displacement[1]],
                share: *share,
            });
        }
        let terms = &mut self.terms;
        terms.collect(&shape.shape, (shape.sigma_m, shape.origin_m), axes, &self.parts, whole);
        let n = terms.count;
        let reach = if terms.is_uniform { n } else { 2 * n };
        let [of_f2, of_f1, of_f] = [0, 1, 2].map(|k| k * n * columns);
        let (first, second) = values.split_at_mut(EACH * columns * rows);
        let x = &terms.along_x;
        for (row, out) in first.chunks_exact_mut(EACH * columns).enumerate() {
            let (value_and_y, along_x) = out.split_at_mut(2 * columns);
            let factors = [&terms.value[row..n * rows], &terms.slope[row..n * rows]];
            combine(factors, rows, &x[of_f..], columns, columns, value_and_y);
            combine(
                [&terms.value[row..reach * rows]],
                rows,
                &x[of_f1..],
                columns,
                columns,
                along_x,
            );
        }
        let [left, top] = [core[0][0] - whole[0][0], core[1][0] - whole[1][0]];
        for (k, out) in second
            .chunks_exact_mut((EACH * core_columns).max(1))
            .enumerate()
            .take(core_rows)
        {
            let row = top + k;
            let (xx, rest) = out.split_at_mut(core_columns);
            let (xy, yy) = rest.split_at_mut(core_columns);
            combine(
                [&terms.xx[row..reach * rows]],
                rows,
                &x[of_f2 + left..],
                columns,
                core_columns,
                xx,
            );
            combine(
                [&terms.slope[row..reach * rows]],
                rows,
                &x[of_f1 + left..],
                columns,
                core_columns,
                xy,
            );
            combine([&terms.yy[row..]], rows, &x[of_f + left..], columns, core_columns, yy);
        }
    }

    /// A component of given profiles over all pixels, without derivatives.
    pub fn push_profiles(&mut self, axes: [&Basis; 2], profiles: [&[f64]; 2]) {
        let [nx, ny] = axes.map(|b| b.n);
        let columns = nx.next_multiple_of(4);
        let (index, values) = self.pool.add(None, [[[0, columns], [0, ny]]; 2], [1, 0]);
        self.patches.push(index);
        let rows = values.chunks_exact_mut(columns);
        for (row, y) in rows.zip(&profiles[1][..ny]) {
            row.fill(0.0);
            axpy(*y, &profiles[0][..nx], row);
        }
    }

    #[inline(always)]
    fn patch(&self, i: usize) -> &Patch {
        self.pool.get(self.patches[i])
    }

    /// Numbers in all patches together.
    pub fn footprint(&self) -> f64 {
        let lengths = (0..self.patches.len()).map(|i| self.patch(i).lengths().iter().sum::<usize>());
        lengths.sum::<usize>() as f64
    }

    /// Numbers that a step multiplies in pairs of components.
    pub fn pair_footprint(&self) -> f64 {
        let mut sum = 0;
        for i in 0..self.patches.len() {
            for j in 0..=i {
                let area = |array: usize| {
                    size(overlap(self.span(i, array), self.span(j, array)))
                        .iter()
                        .product::<usize>()
                };
                sum += area(0) + 12 * area(ARRAY_OF_CORE);
            }
        }
        sum as f64
    }

    /// What an array of component `i` covers: nothing where it has none.
    #[inline(always)]
    fn span(&self, i: usize, array: usize) -> Span {
        let patch = self.patch(i);
        let part = array / EACH;
        if array % EACH < patch.arrays[part] {
            patch.spans[part]
        } else {
            [[0; 2]; 2]
        }
    }

    /// What of an array shapes a step with a background: a source's slopes, over its core.
    #[inline(always)]
    fn span_of_step(&self, i: usize, array: usize) -> Span {
        let patch = self.patch(i);
        if array > 0 && patch.arrays[1] > 0 {
            patch.spans[1]
        } else {
            self.span(i, array)
        }
    }

    /// Columns of an array of component `i` in row `y`, both within its span.
    #[inline(always)]
    fn row(&self, i: usize, array: usize, y: usize, [x0, x1]: [usize; 2]) -> &[f64] {
        let patch = self.patch(i);
        let part = array / EACH;
        let [[first, last], [top, _]] = patch.spans[part];
        let before = if part == 0 { 0 } else { patch.lengths()[0] };
        let start = before + ((y - top) * patch.arrays[part] + array % EACH) * (last - first);
        &patch.values[start + x0 - first..start + x1 - first]
    }

    /// Adds `scale` times the derivative of orders `a` and `b` along x and y of component `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn accumulate(&self, i: usize, a: usize, b: usize, scale: f64, matrix: &mut [f64]) {
        let [[x0, x1], [y0, y1]] = self.span(i, array(a, b));
        for y in y0..y1 {
            let row = self.row(i, array(a, b), y, [x0, x1]);
            axpy(scale, row, &mut matrix[y * self.mx + x0..y * self.mx + x1]);
        }
    }

    /// Inner products of a matrix (my, mx) with derivatives of component `i`.
    #[inline(always)]
    pub fn project<const N: usize>(&self, i: usize, derivatives: [[usize; 2]; N], matrix: &[f64]) -> [f64; N] {
        let mut sum = [0.0; N];
        for k in 0..N {
            let of = array(derivatives[k][0], derivatives[k][1]);
            let [[x0, x1], [y0, y1]] = self.span(i, of);
            let mut sums = [[0.0; 4]; 4];
            for y in y0..y1 {
                let row = self.row(i, of, y, [x0, x1]);
                add_products([row, &matrix[y * self.mx + x0..y * self.mx + x1]], &mut sums);
            }
            sum[k] = sums.as_flattened().iter().sum();
        }
        sum
    }

    /// Inner product of a derivative of component `i` with one of component `j` under `weights` (my, mx), or none where that is empty.
    #[inline(always)]
    pub fn inner_product(&self, i: usize, a: [usize; 2], j: usize, b: [usize; 2], weights: &[f64]) -> f64 {
        let (a, b) = (array(a[0], a[1]), array(b[0], b[1]));
        let within = overlap(self.span(i, a), self.span(j, b));
        self.inner_product_over(within, i, a, j, b, weights)
    }

    #[inline(always)]
    fn inner_product_over(&self, within: Span, i: usize, a: usize, j: usize, b: usize, weights: &[f64]) -> f64 {
        let [[x0, x1], [y0, y1]] = within;
        let mut sums = [[0.0; 4]; 4];
        for y in y0..y1 {
            let (p, q) = (self.row(i, a, y, [x0, x1]), self.row(j, b, y, [x0, x1]));
            if weights.is_empty() {
                add_products([p, q], &mut sums);
            } else {
                add_products([&weights[y * self.mx + x0..y * self.mx + x1], p, q], &mut sums);
            }
        }
        sums.as_flattened().iter().sum()
    }

    /// Inner products of three derivatives of component `i` with three of component `j`, 3 × 3 row-major: over the cores of sources, but
    /// for the light of one with a background.
    #[inline(always)]
    pub fn inner_products(&self, i: usize, a: Orders, j: usize, b: Orders, weights: &[f64]) -> [f64; 9] {
        let mut out = [0.0; 9];
        let has_cores = self.patch(i).arrays[1] > 0 && self.patch(j).arrays[1] > 0;
        if !has_cores || weights.is_empty() {
            for r in 0..3 {
                for c in 0..3 {
                    let (a, b) = (array(a[r][0], a[r][1]), array(b[c][0], b[c][1]));
                    let within = overlap(self.span_of_step(i, a), self.span_of_step(j, b));
                    out[3 * r + c] = self.inner_product_over(within, i, a, j, b, weights);
                }
            }
            return out;
        }
        let [columns, [y0, y1]] = overlap(self.span(i, ARRAY_OF_CORE), self.span(j, ARRAY_OF_CORE));
        for y in y0..y1 {
            let mut rows = [[&[][..]; 3]; 2];
            for k in 0..3 {
                rows[0][k] = self.row(i, array(a[k][0], a[k][1]), y, columns);
                rows[1][k] = self.row(j, array(b[k][0], b[k][1]), y, columns);
            }
            add_weighted_products(
                &weights[y * self.mx + columns[0]..y * self.mx + columns[1]],
                rows,
                &mut out,
            );
        }
        out
    }
}

/// What two spans share.
#[inline(always)]
fn overlap(p: Span, q: Span) -> Span {
    let [left, right] = [p[0][0].max(q[0][0]), p[0][1].min(q[0][1])];
    let [top, bottom] = [p[1][0].max(q[1][0]), p[1][1].min(q[1][1])];
    if left < right && top < bottom {
        [[left, right], [top, bottom]]
    } else {
        [[0; 2]; 2]
    }
}

/// Adds Σ w pᵣ q꜀ of three rows p and three rows q to a 3 × 3 block; lengths are multiples of four.
#[inline(always)]
fn add_weighted_products(w: &[f64], [p, q]: [[&[f64]; 3]; 2], out: &mut [f64; 9]) {
    let w = w.as_chunks::<4>().0;
    let n = w.len();
    let (mut a, mut b) = ([w; 3], [w; 3]);
    for k in 0..3 {
        (a[k], b[k]) = (&p[k].as_chunks::<4>().0[..n], &q[k].as_chunks::<4>().0[..n]);
    }
    let mut lanes = [[0.0; 4]; 9];
    for k in 0..n {
        for c in 0..3 {
            let mut weighted = b[c][k];
            for l in 0..4 {
                weighted[l] *= w[k][l];
            }
            for r in 0..3 {
                for l in 0..4 {
                    lanes[3 * r + c][l] += a[r][k][l] * weighted[l];
                }
            }
        }
    }
    for m in 0..9 {
        let [a, b, c, d] = lanes[m];
        out[m] += (a + c) + (b + d);
    }
}
