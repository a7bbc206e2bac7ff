//! The predicted frame of a hypothesis: components (sources, then background terms), each a sum of separable terms.
//!
//! A source whose PSF is aligned with the axes is one term. A rotated ellipse is no product of profiles: it is an aligned PSF smeared
//! along a diagonal, which Gauss–Hermite quadrature (Abramowitz and Stegun, 1964, 25.4.46) turns into a sum of five or seven. One that motion smears is
//! a sum of displaced PSFs, of either kind. A measured PSF is a sum of terms whose weights vary over the field, kept as one patch of pixels per source.

use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{BACKGROUND_TERMS, Nuisances, PointSource};
use crate::estimate::model::measured_components::{MeasuredComponents, Orders};
use crate::estimate::model::separable_terms::SeparableTerms;
use crate::estimate::preprocess::masked_pixels::Run;

/// Nodes in σ of the smear, and weights; exact for the first nine moments.
const FIVE_NODES: [(f64, f64); 5] = [
    (0.0, 0.533_333_333_333_333_3),
    (1.355_626_179_974_266, 0.222_075_922_005_612_66),
    (-1.355_626_179_974_266, 0.222_075_922_005_612_66),
    (2.856_970_013_872_805_7, 0.011_257_411_327_720_691),
    (-2.856_970_013_872_805_7, 0.011_257_411_327_720_691),
];
/// The same for the first 13 moments.
const SEVEN_NODES: [(f64, f64); 7] = [
    (0.0, 0.457_142_857_142_857_1),
    (1.154_405_394_739_968_2, 0.240_123_178_605_012_7),
    (-1.154_405_394_739_968_2, 0.240_123_178_605_012_7),
    (2.366_759_410_734_541, 0.030_757_123_967_586_526),
    (-2.366_759_410_734_541, 0.030_757_123_967_586_526),
    (3.750_439_717_725_742_5, 0.000_548_268_855_972_216_7),
    (-3.750_439_717_725_742_5, 0.000_548_268_855_972_216_7),
];
/// Covariance over the smaller variance from which five nodes leave more than 10⁻⁴ of a spot's peak (0.4 % at 0.34, where seven leave a tenth
/// of that).
const NEARLY_ROUND: f64 = 0.18;
pub(crate) const WHOLE: [(f64, f64); 1] = [(0.0, 1.0)];
/// Shares of a component that is one term.
const ONE: [f64; 1] = [1.0];

/// Orders of the derivatives along x and y that go with a source's energy, x and y.
pub(crate) const SLOPES: Orders = [[0, 0], [1, 0], [0, 1]];

/// The same in the order of a Gram matrix's blocks.
const GRAM: Orders = [[1, 0], [0, 1], [0, 0]];

/// Σ share·f(k) over the terms k of component `i`, f an array. A macro, because a closure is not compiled for the instructions that its
/// caller was dispatched to.
macro_rules! sum_terms {
    ($model:ident, $i:expr, |$k:ident| $f:expr) => {{
        let (first, shares) = $model.terms($i);
        let mut sum = Default::default();
        for ($k, share) in (first..).zip(shares) {
            add(&mut sum, *share, $f);
        }
        sum
    }};
}

/// The same over the pairs of a term k of component `i` and a term l of component `j`.
macro_rules! sum_pairs {
    ($model:ident, $i:expr, $j:expr, |$k:ident, $l:ident| $f:expr) => {{
        let ((first, shares), (other, others)) = ($model.terms($i), $model.terms($j));
        let mut sum = Default::default();
        for ($k, share) in (first..).zip(shares) {
            for ($l, of) in (other..).zip(others) {
                add(&mut sum, share * of, $f);
            }
        }
        sum
    }};
}

/// Components in the bases: sources first, then background terms.
#[derive(Default)]
pub(crate) struct SeparableModel {
    pub sources: Vec<PointSource>,
    pub background: [f64; BACKGROUND_TERMS.len()],
    /// Relative to the configured σ.
    pub width: [f64; 2],
    /// The sources' covariance between the axes, σ².
    pub covariance_xy: f64,
    /// Whether the sources' amplitudes may be negative.
    pub has_signed_energies: bool,
    components: usize,
    /// Shares of a source's separable terms.
    shares: Vec<f64>,
    terms: SeparableTerms,
    /// Takes the place of `terms` where the PSF is measured.
    measured: Option<MeasuredComponents>,
    measured_terms: usize,
}

impl SeparableModel {
    pub fn components(&self) -> usize {
        self.components
    }

    /// Multiplications of placing all components and of their inner products with a frame and with each other.
    pub fn pass_cost(&self, is_weighted: bool) -> f64 {
        match &self.measured {
            None if is_weighted => (9.0 + 3.0 * self.components as f64) * self.terms.footprint(),
            None => 9.0 * self.terms.footprint(),
            Some(m) => (self.measured_terms as f64 + 3.0) * m.footprint() + m.pair_footprint(),
        }
    }

    /// Separable terms of a source.
    pub fn terms_per_source(&self) -> f64 {
        self.shares.len() as f64
    }

    /// Whether the PSF is measured.
    pub fn is_measured(&self) -> bool {
        self.measured.is_some()
    }

    /// Whether a source is one separable term.
    pub fn is_upright(&self) -> bool {
        self.measured.is_none() && self.shares.len() == 1
    }

    /// Amplitude of a component.
    #[inline(always)]
    pub fn amplitude(&self, i: usize) -> f64 {
        let n = self.sources.len();
        if i < n {
            self.sources[i].a
        } else {
            self.background[i - n]
        }
    }

    /// Evaluates all terms for the present sources, widths and background.
    #[inline(always)]
    pub fn place(&mut self, bases: &Bases, compressed: &CompressedFrame, nuisances: Nuisances, scratch: &mut Vec<f64>) {
        let axes = bases.axes();
        scratch.resize(scratch.len().max(3 * bases.x.n.max(bases.y.n)), 0.0);
        let n = self.sources.len();
        let motion = compressed.smear.as_ref().map_or(WHOLE.as_slice(), |smear| &smear.nodes);
        let displacement = |u: [f64; 2]| {
            compressed
                .smear
                .as_ref()
                .map_or([0.0; 2], |smear| smear.displacement(u))
        };
        self.components = n + nuisances.background_terms();
        self.shares.clear();
        if let Some(shape) = &bases.shape {
            self.measured_terms = shape.terms() * motion.len();
            let measured = self.measured.get_or_insert_default();
            measured.clear(compressed.mx);
            for s in &self.sources {
                measured.push(shape, axes, s.u, displacement(s.u), motion);
            }
            for kinds in &BACKGROUND_TERMS[..nuisances.background_terms()] {
                measured.push_profiles(axes, [0, 1].map(|k| bases.backgrounds[k][kinds[k]].as_slice()));
            }
            return;
        }
        self.measured = None;
        let least_variance = self.width[0].min(self.width[1]).powi(2);
        let ellipse = match self.covariance_xy.abs() / least_variance {
            0.0 => WHOLE.as_slice(),
            NEARLY_ROUND.. => &SEVEN_NODES,
            _ => &FIVE_NODES,
        };
        for (_, of) in motion {
            self.shares.extend(ellipse.iter().map(|(_, share)| of * share));
        }
        let count = n * self.shares.len() + nuisances.background_terms();
        self.terms.clear(count, compressed.mx, compressed.my);
        let along = self.covariance_xy.abs().sqrt();
        let width = self.width.map(|w| (w * w - self.covariance_xy.abs()).max(0.0).sqrt());
        for s in &self.sources {
            let [dx, dy] = displacement(s.u);
            for (m, _) in motion {
                for (t, _) in ellipse {
                    let (x, y) = (t * along, t * along * self.covariance_xy.signum());
                    let u = [s.u[0] + m * dx + x, s.u[1] + m * dy + y];
                    self.terms.push(axes, u, width, compressed.reach, scratch);
                }
            }
        }
        for kinds in &BACKGROUND_TERMS[..nuisances.background_terms()] {
            self.terms
                .push_profiles([0, 1].map(|k| bases.backgrounds[k][kinds[k]].as_slice()));
        }
        self.terms.evaluate_lines(axes, &compressed.masked.lines);
    }

    /// A component's first term, and the shares of all of its terms.
    #[inline(always)]
    fn terms(&self, i: usize) -> (usize, &[f64]) {
        let (n, each) = (self.sources.len(), self.shares.len());
        if i < n {
            (i * each, &self.shares)
        } else {
            (n * each + i - n, &ONE)
        }
    }

    /// Derivatives of component `i` at a masked pixel, of the given orders along x and y.
    #[inline(always)]
    pub fn derivatives_at(&self, i: usize, [x, y]: [usize; 2], derivatives: [[usize; 2]; 3]) -> [f64; 3] {
        let (first, shares) = self.terms(i);
        let mut sum = [0.0; 3];
        for (k, share) in shares.iter().enumerate() {
            let [fx, fy] = self.terms.at(first + k, x, y);
            for (s, [a, b]) in sum.iter_mut().zip(derivatives) {
                *s += share * fx[a] * fy[b];
            }
        }
        sum
    }

    /// [`SeparableModel::gram_block`] over masked pixels alone.
    #[inline(always)]
    pub fn gram_block_over_runs(&self, i: usize, j: usize, runs: &[Run], scratch: &mut Vec<f64>) -> [f64; 9] {
        sum_pairs!(self, i, j, |k, l| self.terms.gram_block_over_runs(k, l, runs, scratch))
    }

    /// Adds `scale`·f_y⁽ᵇ⁾⊗f_x⁽ᵃ⁾ of component `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn accumulate(&self, i: usize, a: usize, b: usize, scale: f64, matrix: &mut [f64]) {
        if let Some(m) = &self.measured {
            return m.accumulate(i, a, b, scale, matrix);
        }
        let (first, shares) = self.terms(i);
        for (k, share) in shares.iter().enumerate() {
            self.terms.accumulate(first + k, a, b, share * scale, matrix);
        }
    }

    /// Adds `f_y⊗(q0[0] f″_x + q0[1] f′_x) + f′_y⊗(q1[0] f′_x + q1[1] f_x) + q2 f″_y⊗f_x` of component `i` to a matrix (my, mx).
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
        if let Some(m) = &self.measured {
            m.accumulate(i, 2, 0, q0[0], matrix);
            m.accumulate(i, 1, 0, q0[1], matrix);
            m.accumulate(i, 1, 1, q1[0], matrix);
            m.accumulate(i, 0, 1, q1[1], matrix);
            m.accumulate(i, 0, 2, q2, matrix);
            return;
        }
        let (first, shares) = self.terms(i);
        for (k, share) in shares.iter().enumerate() {
            let (q0, q1) = ([share * q0[0], share * q0[1]], [share * q1[0], share * q1[1]]);
            self.terms
                .accumulate_second_derivative(first + k, q0, q1, share * q2, scratch, matrix);
        }
    }

    /// Inner products of a matrix (my, mx) with f_y⊗f_x, f_y⊗f′_x and f′_y⊗f_x of component `i`.
    #[inline(always)]
    pub fn project(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        if let Some(m) = &self.measured {
            return m.project(i, SLOPES, matrix);
        }
        sum_terms!(self, i, |k| self.terms.project(k, matrix, scratch))
    }

    /// Jᵀ times a matrix (my, mx): J's columns are every source's x, y and energy, then the background's amplitudes.
    #[inline(always)]
    pub fn transposed_jacobian_times(&self, matrix: &[f64], scratch: &mut Vec<f64>, out: &mut [f64]) {
        for i in 0..self.components {
            self.set_jacobian(i, self.project(i, matrix, scratch), out);
        }
    }

    /// The row of J at a masked pixel.
    #[inline(always)]
    pub fn jacobian_row_at(&self, pixel: [usize; 2], out: &mut [f64]) {
        for i in 0..self.components {
            self.set_jacobian(i, self.derivatives_at(i, pixel, SLOPES), out);
        }
    }

    /// Sets what belongs to component `i` in a vector over the columns of J, from inner products with [`SLOPES`] of it.
    #[inline(always)]
    pub fn set_jacobian(&self, i: usize, [value, along_x, along_y]: [f64; 3], out: &mut [f64]) {
        let n = self.sources.len();
        if i < n {
            let a = self.sources[i].a;
            (out[3 * i], out[3 * i + 1], out[3 * i + 2]) = (a * along_x, a * along_y, value);
        } else {
            out[2 * n + i] = value;
        }
    }

    /// The first value of [`Self::project`] alone.
    #[inline(always)]
    pub fn project_value(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> f64 {
        if let Some(m) = &self.measured {
            return m.project(i, [[0, 0]], matrix)[0];
        }
        let [value] = sum_terms!(self, i, |k| [self.terms.project_value(k, matrix, scratch)]);
        value
    }

    /// Inner products with the second derivatives: xx, xy, yy.
    #[inline(always)]
    pub fn project_second_derivatives(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        if let Some(m) = &self.measured {
            return m.project(i, [[2, 0], [1, 1], [0, 2]], matrix);
        }
        sum_terms!(self, i, |k| self.terms.project_second_derivatives(k, matrix, scratch))
    }

    /// Inner product of component `i`'s derivative, `a[0]` times along x and `a[1]` times along y, with component `j`'s under `weights`
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
        if let Some(m) = &self.measured {
            return m.inner_product(i, a, j, b, weights);
        }
        let [sum] = sum_pairs!(self, i, j, |k, l| [self
            .terms
            .inner_product(k, a, l, b, weights, scratch)]);
        sum
    }

    /// Inner products of three derivatives of component `i` with three of component `j`, 3 × 3 row-major.
    #[inline(always)]
    pub fn inner_products(
        &self,
        i: usize,
        a: Orders,
        j: usize,
        b: Orders,
        weights: &[f64],
        scratch: &mut Vec<f64>,
    ) -> [f64; 9] {
        if let Some(m) = &self.measured {
            return m.inner_products(i, a, j, b, weights);
        }
        let mut products = [0.0; 9];
        for r in 0..3 {
            for c in 0..3 {
                products[3 * r + c] = self.inner_product(i, a[r], j, b[c], weights, scratch);
            }
        }
        products
    }

    /// Inner products along x and along y of component `i`'s f, f′ and f″ with component `j`'s f and f′; `None` where they share nothing.
    /// Only of sources that are upright.
    #[inline(always)]
    pub fn axis_inner_products(&self, i: usize, j: usize) -> Option<[[[f64; 2]; 3]; 2]> {
        debug_assert!(self.measured.is_none(), "a measured PSF is fitted with weights");
        self.terms.axis_inner_products(i, j)
    }

    /// Inner products of (f′_x f_y, f_x f′_y, f_x f_y) of component `i` with those of component `j`, 3 × 3 row-major.
    #[inline(always)]
    pub fn gram_block(&self, i: usize, j: usize, weights: &[f64], scratch: &mut Vec<f64>) -> [f64; 9] {
        if let Some(m) = &self.measured {
            return m.inner_products(i, GRAM, j, GRAM, weights);
        }
        sum_pairs!(self, i, j, |k, l| self.terms.gram_block(k, l, weights, scratch))
    }
}

#[inline(always)]
fn add<const N: usize>(sum: &mut [f64; N], share: f64, values: [f64; N]) {
    for k in 0..N {
        sum[k] += share * values[k];
    }
}
