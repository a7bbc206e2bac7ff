//! The covariance, condition number and determinant of an information matrix.

use crate::estimate::dense_linalg::{cholesky, invert};
use crate::estimate::fit::levenberg_marquardt::Fitter;

/// Relative increase of the diagonal of an information matrix before it is factorised: singular ones are regularised.
pub(crate) const RIDGE: f64 = 1e-13;

impl Fitter {
    /// Inverse of an information matrix of `n` parameters with `prior` precision added to the sources' positions.
    pub fn covariance(&mut self, n: usize, sources: usize, prior: f64, out: &mut Vec<f64>) -> bool {
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..n * n]);
        for i in 0..sources {
            self.factor[3 * i * n + 3 * i] += prior;
            self.factor[(3 * i + 1) * n + 3 * i + 1] += prior;
        }
        for i in 0..n {
            self.factor[i * n + i] *= 1.0 + RIDGE;
        }
        out.clear();
        out.resize(n * n, 0.0);
        let factor = &mut self.factor;
        pulp::Arch::new().dispatch(Inverse { factor, n, out })
    }

    /// Condition number (1-norm) of an information matrix of `n` parameters, scaled to a unit diagonal (van der Sluis, 1969: no
    /// other scaling does much better), given its inverse.
    pub fn condition_number(&self, n: usize, inverse: &[f64]) -> f64 {
        let scale = |i: usize| self.hessian[i * n + i].max(1e-300).sqrt();
        let column = |j: usize| {
            let (mut direct, mut inverted) = (0.0, 0.0);
            for i in 0..n {
                let h = self.hessian[i.min(j) * n + i.max(j)];
                direct += (h / (scale(i) * scale(j))).abs();
                inverted += (inverse[i * n + j] * scale(i) * scale(j)).abs();
            }
            (direct, inverted)
        };
        let (direct, inverted) = (0..n)
            .map(column)
            .fold((0.0f64, 0.0f64), |most, c| (most.0.max(c.0), most.1.max(c.1)));
        (direct * inverted).max(1.0)
    }

    /// ln det of an information matrix of `n` parameters over the places and energies of its sources, with each source's `floor` added
    /// to the precisions.
    pub fn log_det(&mut self, n: usize, floor: &[[f64; 3]]) -> Option<f64> {
        let size = 3 * floor.len();
        self.factor.clear();
        for i in 0..size {
            self.factor.extend_from_slice(&self.hessian[i * n..i * n + size]);
            self.factor[i * size + i] *= 1.0 + RIDGE;
            self.factor[i * size + i] += floor[i / 3][i % 3];
        }
        let is_regular = cholesky(&mut self.factor, size);
        is_regular.then(|| (0..size).map(|i| 2.0 * self.factor[i * size + i].ln()).sum())
    }
}

struct Inverse<'a> {
    factor: &'a mut [f64],
    n: usize,
    out: &'a mut [f64],
}

impl pulp::NullaryFnOnce for Inverse<'_> {
    type Output = bool;

    #[inline(always)]
    fn call(self) -> bool {
        let is_regular = cholesky(self.factor, self.n);
        if is_regular {
            invert(self.factor, self.n, self.out);
        }
        is_regular
    }
}
