//! The sources of a hypothesis: spots, then background atoms, each a sum of separable parts.
//!
//! An upright spot is one part. One whose ellipse is turned against the axes is no product of profiles: it is an upright one
//! smeared along a diagonal, and Gauss–Hermite quadrature (Abramowitz and Stegun, 1964, 25.4.46) makes that a sum of few.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Nuisances, Spot};
use crate::estimate::model::separable_terms::Parts;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::masked_pixels::Run;

/// Places along the smear, in its σ, and their shares; exact for the first nine moments.
const SMEAR: [(f64, f64); 5] = [
    (0.0, 0.533_333_333_333_333_3),
    (1.355_626_179_974_266, 0.222_075_922_005_612_66),
    (-1.355_626_179_974_266, 0.222_075_922_005_612_66),
    (2.856_970_013_872_805_7, 0.011_257_411_327_720_691),
    (-2.856_970_013_872_805_7, 0.011_257_411_327_720_691),
];
const WHOLE: [(f64, f64); 1] = [(0.0, 1.0)];

/// What goes with a spot's energy, x and y.
pub(crate) const SLOPES: [[usize; 2]; 3] = [[0, 0], [1, 0], [0, 1]];

/// Sources in the bases. Spots come first, then background atoms.
#[derive(Default)]
pub(crate) struct Atoms {
    pub spots: Vec<Spot>,
    pub background: [f64; 3],
    /// Relative to the configured σ.
    pub width: [f64; 2],
    /// The spots' covariance between the axes, σ².
    pub turn: f64,
    sources: usize,
    parts: Parts,
}

/// Constant and sloped profiles along one axis, of about a spot's norm, so that the normal equations are well scaled.
pub(crate) fn background(b: &Basis) -> [Vec<f64>; 2] {
    let (half, norm) = (0.5 * b.n as f64, (b.n as f64).sqrt());
    let mut pair = [vec![0.0; b.stride], vec![0.0; b.stride]];
    b.compress((0..b.n).map(|_| 1.0 / norm), &mut pair[0]);
    b.compress((0..b.n).map(|k| (k as f64 + 0.5 - half) / half / norm), &mut pair[1]);
    pair
}

impl Atoms {
    pub fn sources(&self) -> usize {
        self.sources
    }

    /// Numbers that all sources touch together.
    pub fn footprint(&self) -> f64 {
        self.parts.footprint()
    }

    /// Products that a spot is a sum of.
    pub fn parts_a_spot(&self) -> f64 {
        self.smear(0).len() as f64
    }

    /// Amplitude of a source.
    #[inline(always)]
    pub fn amplitude(&self, i: usize) -> f64 {
        let n = self.spots.len();
        if i < n { self.spots[i].a } else { self.background[i - n] }
    }

    /// Fills the atoms for the present spots, shape and kinds of background.
    #[inline(always)]
    pub fn place(
        &mut self,
        axes: [&Basis; 2],
        backgrounds: [&[Vec<f64>; 2]; 2],
        reading: &Reading,
        nuisances: Nuisances,
        scratch: &mut [f64],
    ) {
        let n = self.spots.len();
        let smear = self.smear(0);
        self.sources = n + nuisances.background_atoms();
        let count = n * smear.len() + nuisances.background_atoms();
        self.parts.clear(count, reading.mx, reading.my);
        let along = self.turn.abs().sqrt();
        let width = self.width.map(|w| (w * w - self.turn.abs()).max(0.0).sqrt());
        for s in &self.spots {
            for (t, _) in smear {
                let u = [s.u[0] + t * along, s.u[1] + t * along * self.turn.signum()];
                self.parts.push(axes, u, width, reading.reach, scratch);
            }
        }
        for b in 0..nuisances.background_atoms() {
            let kinds = [usize::from(b == 1), usize::from(b == 2)];
            self.parts
                .push_flat([0, 1].map(|k| backgrounds[k][kinds[k]].as_slice()));
        }
        self.parts.expand(axes, &reading.bad.lines);
    }

    /// The parts' places and shares in a source.
    #[inline(always)]
    fn smear(&self, i: usize) -> &'static [(f64, f64)] {
        if self.turn != 0.0 && i < self.spots.len() {
            &SMEAR
        } else {
            &WHOLE
        }
    }

    /// A source's first part, and the shares of all of them in it.
    #[inline(always)]
    fn parts(&self, i: usize) -> (usize, &'static [(f64, f64)]) {
        let n = self.spots.len();
        let each = self.smear(0).len();
        (if i < n { i * each } else { n * each + i - n }, self.smear(i))
    }

    /// Derivatives of source `i` at an unusable pixel, each so many times along x and y.
    #[inline(always)]
    pub fn at(&self, i: usize, [x, y]: [usize; 2], derivatives: [[usize; 2]; 3]) -> [f64; 3] {
        let (first, shares) = self.parts(i);
        let mut sum = [0.0; 3];
        for (k, (_, share)) in shares.iter().enumerate() {
            let [fx, fy] = self.parts.at(first + k, x, y);
            for (s, [a, b]) in sum.iter_mut().zip(derivatives) {
                *s += share * fx[a] * fy[b];
            }
        }
        sum
    }

    /// [`Atoms::couple`] over unusable pixels alone.
    #[inline(always)]
    pub fn couple_at(&self, i: usize, j: usize, runs: &[Run], scratch: &mut Vec<f64>) -> [f64; 9] {
        let ((first, shares), (other, others)) = (self.parts(i), self.parts(j));
        let mut sum = [0.0; 9];
        for (k, (_, share)) in shares.iter().enumerate() {
            for (l, (_, of)) in others.iter().enumerate() {
                add(
                    &mut sum,
                    share * of,
                    self.parts.couple_at(first + k, other + l, runs, scratch),
                );
            }
        }
        sum
    }

    /// Adds `scale`·f_y⁽ᵇ⁾⊗f_x⁽ᵃ⁾ of source `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn add(&self, i: usize, a: usize, b: usize, scale: f64, matrix: &mut [f64]) {
        let (first, shares) = self.parts(i);
        for (k, (_, share)) in shares.iter().enumerate() {
            self.parts.add(first + k, a, b, share * scale, matrix);
        }
    }

    /// Adds `f_y⊗(q0[0] f″_x + q0[1] f′_x) + f′_y⊗(q1[0] f′_x + q1[1] f_x) + q2 f″_y⊗f_x` of source `i` to a matrix (my, mx).
    #[inline(always)]
    pub fn add_bent(&self, i: usize, q0: [f64; 2], q1: [f64; 2], q2: f64, scratch: &mut Vec<f64>, matrix: &mut [f64]) {
        let (first, shares) = self.parts(i);
        for (k, (_, share)) in shares.iter().enumerate() {
            let (q0, q1) = ([share * q0[0], share * q0[1]], [share * q1[0], share * q1[1]]);
            self.parts.add_bent(first + k, q0, q1, share * q2, scratch, matrix);
        }
    }

    /// Inner products of a matrix (my, mx) with f_y⊗f_x, f_y⊗f′_x and f′_y⊗f_x of source `i`.
    #[inline(always)]
    pub fn project(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        let (first, shares) = self.parts(i);
        let mut sum = [0.0; 3];
        for (k, (_, share)) in shares.iter().enumerate() {
            add(&mut sum, *share, self.parts.project(first + k, matrix, scratch));
        }
        sum
    }

    /// Inner products of a matrix (my, mx) with the model's slopes in every spot's x, y and energy, then in the background.
    #[inline(always)]
    pub fn slopes(&self, matrix: &[f64], scratch: &mut Vec<f64>, out: &mut [f64]) {
        for i in 0..self.sources {
            self.set_slope(i, self.project(i, matrix, scratch), out);
        }
    }

    /// The same at an unusable pixel.
    #[inline(always)]
    pub fn slopes_at(&self, pixel: [usize; 2], out: &mut [f64]) {
        for i in 0..self.sources {
            self.set_slope(i, self.at(i, pixel, SLOPES), out);
        }
    }

    #[inline(always)]
    fn set_slope(&self, i: usize, [value, along_x, along_y]: [f64; 3], out: &mut [f64]) {
        let n = self.spots.len();
        if i < n {
            let a = self.spots[i].a;
            (out[3 * i], out[3 * i + 1], out[3 * i + 2]) = (a * along_x, a * along_y, value);
        } else {
            out[2 * n + i] = value;
        }
    }

    /// The first of these alone.
    #[inline(always)]
    pub fn project_value(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> f64 {
        let (first, shares) = self.parts(i);
        let mut sum = 0.0;
        for (k, (_, share)) in shares.iter().enumerate() {
            sum += share * self.parts.project_value(first + k, matrix, scratch);
        }
        sum
    }

    /// Inner products with the second derivatives: xx, xy, yy.
    #[inline(always)]
    pub fn bend(&self, i: usize, matrix: &[f64], scratch: &mut Vec<f64>) -> [f64; 3] {
        let (first, shares) = self.parts(i);
        let mut sum = [0.0; 3];
        for (k, (_, share)) in shares.iter().enumerate() {
            add(&mut sum, *share, self.parts.bend(first + k, matrix, scratch));
        }
        sum
    }

    /// Inner product of source `i`'s derivative, `a[0]` times along x and `a[1]` times along y, with source `j`'s under `weights`
    /// (my, mx), even where that is empty.
    #[inline(always)]
    pub fn inner(
        &self,
        i: usize,
        a: [usize; 2],
        j: usize,
        b: [usize; 2],
        weights: &[f64],
        scratch: &mut Vec<f64>,
    ) -> f64 {
        let ((first, shares), (other, others)) = (self.parts(i), self.parts(j));
        let mut sum = 0.0;
        for (k, (_, share)) in shares.iter().enumerate() {
            for (l, (_, of)) in others.iter().enumerate() {
                sum += share * of * self.parts.inner(first + k, a, other + l, b, weights, scratch);
            }
        }
        sum
    }

    /// Inner products along x and along y of source `i`'s f, f′ and f″ with source `j`'s f and f′; `None` where they share nothing.
    /// Only of spots that are upright.
    #[inline(always)]
    pub fn grams(&self, i: usize, j: usize) -> Option<[[[f64; 2]; 3]; 2]> {
        self.parts.grams(i, j)
    }

    /// Inner products of (f′_x f_y, f_x f′_y, f_x f_y) of source `i` with those of source `j`, 3 × 3 row-major.
    #[inline(always)]
    pub fn couple(&self, i: usize, j: usize, weights: &[f64], scratch: &mut Vec<f64>) -> [f64; 9] {
        let ((first, shares), (other, others)) = (self.parts(i), self.parts(j));
        let mut sum = [0.0; 9];
        for (k, (_, share)) in shares.iter().enumerate() {
            for (l, (_, of)) in others.iter().enumerate() {
                add(
                    &mut sum,
                    share * of,
                    self.parts.couple(first + k, other + l, weights, scratch),
                );
            }
        }
        sum
    }
}

#[inline(always)]
fn add<const N: usize>(sum: &mut [f64; N], share: f64, values: [f64; N]) {
    for k in 0..N {
        sum[k] += share * values[k];
    }
}
