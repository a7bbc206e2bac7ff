//! The covariance, condition number and determinant of normal equations.

use nalgebra::{Cholesky, DMatrix};

use crate::estimate::dense_linalg::{cholesky, dispatch, invert};
use crate::estimate::fit::normal_equations::NormalEquations;

/// Relative increase of the diagonal of an information matrix before it is factorised: singular ones are regularised.
pub(crate) const RIDGE: f64 = 1e-13;

/// The inverse of an information matrix, (p, p) row-major.
#[derive(Clone, Debug)]
pub(crate) struct Covariance {
    pub parameters: usize,
    pub matrix: Vec<f64>,
}

impl Covariance {
    /// `None` where the information is singular. `prior` is a precision added to the sources' positions.
    pub fn new(equations: &NormalEquations, prior: f64) -> Option<Self> {
        Self::inverse_of(equations.information.clone(), equations, prior)
    }

    /// The same with further information on the positions, over x and y of each source.
    pub fn with_known(equations: &NormalEquations, prior: f64, known: &DMatrix<f64>) -> Option<Self> {
        let (n, mut information) = (equations.parameters, equations.information.clone());
        let at = |k: usize| 3 * (k / 2) + k % 2;
        for r in 0..known.nrows() {
            for c in r..known.ncols() {
                information[at(r) * n + at(c)] += known[(r, c)];
            }
        }
        Self::inverse_of(information, equations, prior)
    }

    fn inverse_of(mut factor: Vec<f64>, equations: &NormalEquations, prior: f64) -> Option<Self> {
        let n = equations.parameters;
        for i in 0..equations.sources {
            factor[3 * i * n + 3 * i] += prior;
            factor[(3 * i + 1) * n + 3 * i + 1] += prior;
        }
        for i in 0..n {
            factor[i * n + i] *= 1.0 + RIDGE;
        }
        let mut matrix = vec![0.0; n * n];
        let is_regular = dispatch!(<'a>
        factor: &'a mut [f64] = &mut factor,
        n: usize = n,
        out: &'a mut [f64] = &mut matrix
        => bool: cholesky(factor, n) && {
            invert(factor, n, out);
            true
        });
        is_regular.then_some(Self { parameters: n, matrix })
    }

    /// C M C for the information M of other weights: the covariance of a fit whose weights are not its data's inverse variances (White,
    /// 1980).
    pub fn sandwich(&self, equations: &NormalEquations) -> Self {
        let n = self.parameters;
        let m = |i: usize, j: usize| equations.information[i.min(j) * n + i.max(j)];
        let mut half = vec![0.0; n * n];
        let mut matrix = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..n {
                half[i * n + j] = (0..n).map(|k| self.matrix[i * n + k] * m(k, j)).sum();
            }
        }
        for i in 0..n {
            for j in i..n {
                let value = (0..n).map(|k| half[i * n + k] * self.matrix[k * n + j]).sum();
                matrix[i * n + j] = value;
                matrix[j * n + i] = value;
            }
        }
        Self { parameters: n, matrix }
    }

    /// Covariance of parameter `r` of source `i` with parameter `c` of source `j`: 0 and 1 are the position, 2 the energy.
    pub fn at(&self, i: usize, r: usize, j: usize, c: usize) -> f64 {
        self.matrix[(3 * i + r) * self.parameters + 3 * j + c]
    }

    /// Covariance of the positions of two sources, or of one with itself, σ².
    pub fn block(&self, i: usize, j: usize) -> [[f64; 2]; 2] {
        [0, 1].map(|r| [0, 1].map(|c| self.at(i, r, j, c)))
    }
}

/// Information on the positions, (x, y) of each source, with energies and nuisances projected out: the Schur complement. `None` where these
/// are singular.
pub(crate) fn position_information(equations: &NormalEquations) -> Option<DMatrix<f64>> {
    let (p, n) = (equations.parameters, equations.sources);
    let entry = |a: usize, b: usize| equations.information[a.min(b) * p + a.max(b)];
    let positions: Vec<usize> = (0..2 * n).map(|k| 3 * (k / 2) + k % 2).collect();
    let others: Vec<usize> = (0..p).filter(|k| *k >= 3 * n || k % 3 == 2).collect();
    let of = |rows: &[usize], columns: &[usize]| {
        DMatrix::from_fn(rows.len(), columns.len(), |r, c| entry(rows[r], columns[c]))
    };
    let mut inner = of(&others, &others);
    for k in 0..others.len() {
        inner[(k, k)] *= 1.0 + RIDGE;
    }
    let cross = of(&others, &positions);
    let factor = Cholesky::new(inner)?;
    Some(of(&positions, &positions) - cross.tr_mul(&factor.solve(&cross)))
}

/// Condition number (1-norm) of the information matrix, scaled to a unit diagonal (van der Sluis, 1969: no other scaling does much
/// better), given its inverse.
pub(crate) fn condition_number(equations: &NormalEquations, inverse: &Covariance) -> f64 {
    let (n, information) = (equations.parameters, &equations.information);
    let scale = |i: usize| information[i * n + i].max(1e-300).sqrt();
    let column = |j: usize| {
        let (mut direct, mut inverted) = (0.0, 0.0);
        for i in 0..n {
            let h = information[i.min(j) * n + i.max(j)];
            direct += (h / (scale(i) * scale(j))).abs();
            inverted += (inverse.matrix[i * n + j] * scale(i) * scale(j)).abs();
        }
        (direct, inverted)
    };
    let (direct, inverted) = (0..n)
        .map(column)
        .fold((0.0f64, 0.0f64), |most, c| (most.0.max(c.0), most.1.max(c.1)));
    (direct * inverted).max(1.0)
}

/// ln det of the information over the positions and energies of the sources, with each source's `floor` added to the precisions.
/// `None` where it is singular.
pub(crate) fn log_det(equations: &NormalEquations, floor: &[[f64; 3]]) -> Option<f64> {
    let (n, size) = (equations.parameters, 3 * floor.len());
    let mut factor = Vec::with_capacity(size * size);
    for i in 0..size {
        factor.extend_from_slice(&equations.information[i * n..i * n + size]);
        factor[i * size + i] *= 1.0 + RIDGE;
        factor[i * size + i] += floor[i / 3][i % 3];
    }
    let is_regular = cholesky(&mut factor, size);
    is_regular.then(|| (0..size).map(|i| 2.0 * factor[i * size + i].ln()).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One source with the information diag(4, 1, 0.25) and a coupling of 1 between x and y.
    fn equations(coupling: f64) -> NormalEquations {
        NormalEquations::of_sources(vec![4.0, coupling, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.25])
    }

    #[test]
    fn the_covariance_of_three_parameters_by_hand() {
        let found = Covariance::new(&equations(1.0), 0.0).expect("regular");
        // [[4, 1], [1, 1]]⁻¹ = [[1, −1], [−1, 4]]/3.
        for (k, expected) in [1.0, -1.0, -1.0, 4.0].into_iter().enumerate() {
            assert!((found.at(0, k / 2, 0, k % 2) - expected / 3.0).abs() < 1e-9);
        }
        assert!((found.at(0, 2, 0, 2) - 4.0).abs() < 1e-9);
        // Scaled to a unit diagonal: [[1, ½], [½, 1]] has the 1-norm 3/2, its inverse 2.
        assert!((condition_number(&equations(1.0), &found) - 3.0).abs() < 1e-9);
        let det = log_det(&equations(1.0), &[[0.0; 3]]).expect("regular");
        assert!((det - 0.75f64.ln()).abs() < 1e-9, "(4 · 1 − 1 · 1) · ¼");
        let floored = log_det(&equations(0.0), &[[0.0, 1.0, 0.75]]).expect("regular");
        assert!((floored - 8.0f64.ln()).abs() < 1e-9, "4 · 2 · 1");
    }

    #[test]
    fn a_prior_makes_positions_regular_that_are_not() {
        // Eigenvalues of [[4, 3], [3, 1]] have both signs.
        assert!(Covariance::new(&equations(3.0), 0.0).is_none());
        assert!(log_det(&equations(3.0), &[[0.0; 3]]).is_none());
        let held = Covariance::new(&equations(3.0), 2.0).expect("regular");
        // [[6, 3], [3, 3]]⁻¹ = [[3, −3], [−3, 6]]/9.
        assert!((held.at(0, 0, 0, 1) + 1.0 / 3.0).abs() < 1e-9);
    }
}
