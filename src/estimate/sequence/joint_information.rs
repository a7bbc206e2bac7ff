//! What is known of all emitters' positions and velocities together: a quadratic log likelihood in information form.

use faer::linalg::solvers::{DenseSolveCore as _, Llt};
use faer::{MatRef, Side};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Numbers of an emitter's state: position (x, y) in σ and velocity in σ/s.
pub(crate) const STATE: usize = 4;
/// Share by which Λ's diagonal is raised where it is inverted: its rounding.
const RIDGE: f64 = 1e-13;

/// −2 ln L(x) = constant − 2 gᵀδ + δᵀΛδ with δ = x − `at`, over the states of all emitters at one time. Λ may be singular: what is not
/// known has no information.
#[derive(Clone, Debug, Default)]
pub(crate) struct JointInformation {
    pub at: DVector<f64>,
    pub gradient: DVector<f64>,
    pub information: DMatrix<f64>,
}

impl JointInformation {
    pub fn len(&self) -> usize {
        self.at.len() / STATE
    }

    /// −2 ln L at `state`, up to the constant.
    pub fn cost(&self, state: &DVector<f64>) -> f64 {
        let step = state - &self.at;
        (&self.information * &step).dot(&step) - 2.0 * self.gradient.dot(&step)
    }

    /// The gradient −½ ∂(−2 ln L)/∂x at `state`.
    pub fn gradient_at(&self, state: &DVector<f64>) -> DVector<f64> {
        &self.gradient - &self.information * (state - &self.at)
    }

    /// The same likelihood, expanded about `state`.
    pub fn recentre(&mut self, state: &DVector<f64>) {
        self.gradient = self.gradient_at(state);
        self.at.copy_from(state);
    }

    /// Adds what a frame `dt` seconds later says of the positions of some emitters: its gradient at `at` and its information.
    pub fn absorb(&mut self, emitters: &[usize], dt: f64, gradient: &DVector<f64>, information: &DMatrix<f64>) {
        for (j, &f) in emitters.iter().enumerate() {
            for l in 0..2 {
                let c = STATE * f + l;
                self.gradient[c] += gradient[2 * j + l];
                self.gradient[c + 2] += dt * gradient[2 * j + l];
                for (i, &e) in emitters.iter().enumerate() {
                    for k in 0..2 {
                        let v = information[(2 * i + k, 2 * j + l)];
                        let r = STATE * e + k;
                        self.information[(r, c)] += v;
                        self.information[(r + 2, c)] += dt * v;
                        self.information[(r, c + 2)] += dt * v;
                        self.information[(r + 2, c + 2)] += dt * dt * v;
                    }
                }
            }
        }
    }

    /// Adds an emitter of which only the variances of position and velocity are known.
    pub fn insert(&mut self, state: [f64; STATE], variance: [f64; 2]) {
        let n = self.at.len();
        self.at = self.at.clone().resize_vertically(n + STATE, 0.0);
        self.gradient = self.gradient.clone().resize_vertically(n + STATE, 0.0);
        self.information = self.information.clone().resize(n + STATE, n + STATE, 0.0);
        for k in 0..STATE {
            self.at[n + k] = state[k];
            self.information[(n + k, n + k)] = 1.0 / variance[k / 2];
            // Velocities are zero before anything is known of them.
            if k >= 2 {
                self.gradient[n + k] = -state[k] / variance[1];
            }
        }
    }

    /// Removes an emitter: what was known of the others through it stays (the Schur complement).
    pub fn marginalise(&mut self, emitter: usize) {
        let n = self.at.len();
        let gone: Vec<usize> = (STATE * emitter..STATE * (emitter + 1)).collect();
        let kept: Vec<usize> = (0..n).filter(|k| !gone.contains(k)).collect();
        let of = |rows: &[usize], columns: &[usize]| {
            DMatrix::from_fn(rows.len(), columns.len(), |r, c| {
                self.information[(rows[r], columns[c])]
            })
        };
        let mut inner = of(&gone, &gone);
        for k in 0..STATE {
            inner[(k, k)] += 1e-12 * inner[(k, k)].abs() + 1e-300;
        }
        let cross = of(&kept, &gone);
        let mut information = of(&kept, &kept);
        let mut gradient = DVector::from_fn(kept.len(), |k, _| self.gradient[kept[k]]);
        if let Some(factor) = Cholesky::new(inner) {
            let weights = factor.solve(&cross.transpose());
            information -= &cross * &weights;
            let own = DVector::from_fn(STATE, |k, _| self.gradient[gone[k]]);
            gradient -= weights.transpose() * own;
        }
        self.at = DVector::from_fn(kept.len(), |k, _| self.at[kept[k]]);
        (self.information, self.gradient) = (information, gradient);
        self.information.fill_lower_triangle_with_upper_triangle();
    }

    /// The same knowledge `dt` seconds later, every emitter having gone straight on: Λ' = F⁻ᵀΛF⁻¹.
    pub fn propagate(&mut self, dt: f64) {
        let n = self.at.len();
        for e in (0..n).step_by(STATE) {
            for k in e..e + 2 {
                self.at[k] += dt * self.at[k + 2];
                let g = self.gradient[k];
                self.gradient[k + 2] -= dt * g;
            }
        }
        // F⁻¹ from the right, then F⁻ᵀ from the left.
        for e in (0..n).step_by(STATE) {
            for k in e..e + 2 {
                for r in 0..n {
                    let p = self.information[(r, k)];
                    self.information[(r, k + 2)] -= dt * p;
                }
            }
        }
        for e in (0..n).step_by(STATE) {
            for k in e..e + 2 {
                for c in 0..n {
                    let p = self.information[(k, c)];
                    self.information[(k + 2, c)] -= dt * p;
                }
            }
        }
    }

    /// Adds process noise of the given covariance to `indices`: (Λ⁻¹ + GQGᵀ)⁻¹ by Woodbury's identity. Returns what this takes off −2 ln L at `at`.
    pub fn add_noise(&mut self, indices: &[usize], noise: &DMatrix<f64>) -> f64 {
        let n = self.at.len();
        let columns = DMatrix::from_fn(n, indices.len(), |r, c| self.information[(r, indices[c])]);
        let inner = DMatrix::from_fn(indices.len(), indices.len(), |r, c| {
            self.information[(indices[r], indices[c])]
        });
        let Some(precision) = noise.clone().try_inverse() else {
            return 0.0;
        };
        let Some(inverse) = (precision + inner).try_inverse() else {
            return 0.0;
        };
        let own = DVector::from_fn(indices.len(), |k, _| self.gradient[indices[k]]);
        let explained = (&inverse * &own).dot(&own);
        let weights = &columns * inverse;
        self.gradient -= &weights * own;
        self.information.gemm(-1.0, &weights, &columns.transpose(), 1.0);
        self.information.fill_lower_triangle_with_upper_triangle();
        explained
    }

    /// Λ⁻¹, where it is regular.
    pub fn covariance(&self) -> Option<DMatrix<f64>> {
        let n = self.at.len();
        let damped = self.damped(RIDGE);
        let factor = Llt::new(MatRef::from_column_major_slice(damped.as_slice(), n, n), Side::Lower).ok()?;
        let inverse = factor.inverse();
        Some(DMatrix::from_fn(n, n, |r, c| inverse[(r, c)]))
    }

    /// The Cholesky factor of Λ with its diagonal raised by `relative`.
    pub fn factor(&self, relative: f64) -> Option<Cholesky<f64, Dyn>> {
        Cholesky::new(self.damped(relative))
    }

    fn damped(&self, relative: f64) -> DMatrix<f64> {
        let mut damped = self.information.clone();
        for k in 0..damped.nrows() {
            let d = damped[(k, k)];
            damped[(k, k)] = d + relative * d.abs() + 1e-300;
        }
        damped
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::JointInformation;

    #[test]
    fn the_covariance_is_the_inverse_and_what_is_not_known_has_none() {
        let of = |information: DMatrix<f64>| JointInformation {
            at: DVector::zeros(4),
            gradient: DVector::zeros(4),
            information,
        };
        let root = DMatrix::from_fn(4, 4, |r, c| 1.0 + (r * r + 3 * c) as f64 % 5.0);
        let known = of(root.tr_mul(&root) + DMatrix::identity(4, 4));
        let covariance = known.covariance().expect("regular");
        assert!((&known.information * &covariance - DMatrix::identity(4, 4)).amax() < 1e-9);
        assert!((&covariance - covariance.transpose()).amax() < 1e-15);
        assert!(of(-DMatrix::identity(4, 4)).covariance().is_none());
    }

    #[test]
    fn noise_takes_off_what_the_best_disturbance_explains() {
        let mut known = JointInformation {
            at: DVector::zeros(4),
            gradient: DVector::from_column_slice(&[3.0, -1.0, 0.5, 2.0]),
            information: DMatrix::from_fn(4, 4, |r, c| if r == c { 4.0 } else { 1.0 }),
        };
        let before = known.clone();
        let explained = known.add_noise(&[1, 3], &DMatrix::from_diagonal_element(2, 2, 0.5));
        let cost =
            |a: f64, b: f64| before.cost(&DVector::from_column_slice(&[0.0, -a, 0.0, -b])) + (a * a + b * b) / 0.5;
        let steps = || (-3000..3000).map(|k| f64::from(k) * 1e-3);
        let least = steps()
            .flat_map(|a| steps().step_by(10).map(move |b| (a, b)))
            .map(|(a, b)| cost(a, b))
            .fold(0.0, f64::min);
        assert!((explained + least).abs() < 1e-3, "{explained} {least}");
    }
}
