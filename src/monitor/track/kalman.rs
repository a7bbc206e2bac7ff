//! A constant-velocity Kalman filter of one beam on the ground.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Matrix2x4, Matrix4, Vector2, Vector4};

use crate::monitor::stats::gaussian::mahalanobis2;

/// Standard deviation of an unknown velocity, m/s, and so of one after a manoeuvre. Larger widens the gate of a new track.
const SPEED_STD: f64 = 8.0;
/// Variance of an adopted velocity, m²/s². Larger widens the gate after a missed frame.
const ADOPTED_VARIANCE: f64 = 1.5;

/// State (x, y, vx, vy) in m and m/s, white-noise acceleration (Bar-Shalom, Li and Kirubarajan, 2001, eqs. 6.2.2-10 to
/// 6.2.2-13).
#[derive(Clone, Copy, Debug)]
pub struct KalmanFilter {
    state: Vector4<f64>,
    cov: Matrix4<f64>,
}

impl KalmanFilter {
    /// At a first measured position, m, of covariance `r`, m²; the velocity is unknown.
    pub fn start(z: Vector2<f64>, r: Matrix2<f64>) -> Self {
        let mut cov = Matrix4::zeros();
        cov.fixed_view_mut::<2, 2>(0, 0).copy_from(&r);
        cov[(2, 2)] = SPEED_STD * SPEED_STD;
        cov[(3, 3)] = SPEED_STD * SPEED_STD;
        Self {
            state: Vector4::new(z.x, z.y, 0.0, 0.0),
            cov,
        }
    }

    /// The mean and covariance of a mixture of filters, each with its probability.
    pub fn mixture(parts: impl Iterator<Item = (f64, Self)> + Clone) -> Self {
        let state: Vector4<f64> = parts.clone().map(|(p, part)| part.state * p).sum();
        let about = |part: &Self| {
            let off = part.state - state;
            part.cov + off * off.transpose()
        };
        let cov = parts.map(|(p, part)| about(&part) * p).sum();
        Self { state, cov }
    }

    /// Predicts the state `dt` seconds later, for a spectral density of the acceleration in m²/s³.
    pub fn predict(&mut self, dt: f64, density: f64) {
        let mut f = Matrix4::identity();
        f[(0, 2)] = dt;
        f[(1, 3)] = dt;
        self.state = f * self.state;
        let moved = f * self.cov * f.transpose();
        self.cov = 0.5 * (moved + moved.transpose());
        let (p, c, v) = (density * dt.powi(3) / 3.0, density * dt.powi(2) / 2.0, density * dt);
        for k in 0..2 {
            self.cov[(k, k)] += p;
            self.cov[(k, k + 2)] += c;
            self.cov[(k + 2, k)] += c;
            self.cov[(k + 2, k + 2)] += v;
        }
        // A long gap must not let the filter forget that users move at bounded speeds.
        for k in 2..4 {
            let excess = (self.cov[(k, k)] / (SPEED_STD * SPEED_STD)).sqrt();
            if excess > 1.0 {
                for i in 0..4 {
                    self.cov[(k, i)] /= excess;
                    self.cov[(i, k)] /= excess;
                }
            }
        }
    }

    /// Squared Mahalanobis distance of a measured position, m, of covariance `r`, m², from the expected.
    pub fn surprise(&self, z: Vector2<f64>, r: Matrix2<f64>) -> f64 {
        mahalanobis2(z - self.position(), self.position_cov() + r)
    }

    /// The beam is somewhere about `z`, m, its velocity unknown.
    pub fn open(&mut self, z: Vector2<f64>) {
        let spread = (z - self.position()).norm_squared();
        for k in 0..2 {
            self.cov[(k, k)] += spread;
            self.cov[(k + 2, k + 2)] = SPEED_STD * SPEED_STD;
        }
    }

    /// Takes a measured position, m, of covariance `r`, m²; gives the logarithm of its probability density, 1/m².
    pub fn update(&mut self, z: Vector2<f64>, r: Matrix2<f64>) -> f64 {
        let innovation = z - self.position();
        let s = self.position_cov() + r;
        let Some(inverse) = s.try_inverse() else {
            return 0.0;
        };
        let h = Matrix2x4::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0);
        let gain = self.cov * h.transpose() * inverse;
        self.state += gain * innovation;
        // Joseph's form stays positive whatever the rounding, and symmetric but for its last bits.
        let left = Matrix4::identity() - gain * h;
        let joseph = left * self.cov * left.transpose() + gain * r * gain.transpose();
        self.cov = 0.5 * (joseph + joseph.transpose());
        -0.5 * (innovation.dot(&(inverse * innovation)) + s.determinant().ln()) - TAU.ln()
    }

    /// Takes over a position, m, of covariance `r`, m², and a velocity, m/s, that hold all that was measured until now.
    pub fn adopt(&mut self, z: Vector2<f64>, r: Matrix2<f64>, velocity: Vector2<f64>) {
        *self = Self::start(z, r);
        for k in 0..2 {
            self.state[k + 2] = velocity[k];
            self.cov[(k + 2, k + 2)] = ADOPTED_VARIANCE;
        }
    }

    /// Moves the state, m and m/s: the axes have moved, not the beam.
    pub fn shift(&mut self, by: Vector2<f64>, velocity: Vector2<f64>) {
        for k in 0..2 {
            self.state[k] += by[k];
            self.state[k + 2] += velocity[k];
        }
    }

    pub fn position(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(0).into()
    }

    pub fn velocity(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(2).into()
    }

    pub fn position_cov(&self) -> Matrix2<f64> {
        self.cov.fixed_view::<2, 2>(0, 0).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_prediction_and_one_update_by_hand() {
        let mut filter = KalmanFilter::start(Vector2::zeros(), Matrix2::identity());
        filter.predict(1.0, 1.5);
        // 1 + 8²·1² + 1.5/3, before the speed is bounded to 8 m/s again.
        let variance = 1.0 + 64.0 + 0.5;
        assert!((filter.position_cov()[(0, 0)] - variance).abs() < 1e-12);
        let z = Vector2::new(3.0, 0.0);
        assert!((filter.surprise(z, Matrix2::identity()) - 9.0 / (variance + 1.0)).abs() < 1e-12);
        let ln_density = filter.update(z, Matrix2::identity());
        assert!((filter.position().x - 3.0 * variance / (variance + 1.0)).abs() < 1e-12);
        assert!((filter.position_cov()[(0, 0)] - variance / (variance + 1.0)).abs() < 1e-9);
        let expected = -0.5 * 9.0 / (variance + 1.0) - (TAU * (variance + 1.0)).ln();
        assert!((ln_density - expected).abs() < 1e-12);
    }

    #[test]
    fn a_mixture_is_as_wide_as_its_parts_are_apart() {
        let at = |x: f64| KalmanFilter::start(Vector2::new(x, 0.0), Matrix2::identity());
        let both = KalmanFilter::mixture([(0.25, at(0.0)), (0.75, at(4.0))].into_iter());
        assert_eq!(both.position(), Vector2::new(3.0, 0.0));
        // 1 + 0.25·9 + 0.75·1.
        assert_eq!(both.position_cov(), Matrix2::new(4.0, 0.0, 0.0, 1.0));
    }

    #[test]
    fn a_long_gap_grows_no_faster_than_the_speed_bound() {
        let mut filter = KalmanFilter::start(Vector2::zeros(), Matrix2::identity());
        for _ in 0..100 {
            filter.predict(1.0, 1.5);
        }
        assert!(filter.position_cov()[(0, 0)].sqrt() < 100.0 * SPEED_STD);
    }
}
