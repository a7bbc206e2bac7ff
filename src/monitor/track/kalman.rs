//! A constant-velocity Kalman filter of one beam on the ground.

use nalgebra::{Matrix2, Matrix2x4, Matrix4, Vector2, Vector4};

use crate::monitor::stats::gaussian::mahalanobis2;

/// Spectral density of the acceleration, m²/s³. Larger follows turns and averages less; a walker may turn round within a second
/// or two. Checked by `follows_a_walker_and_a_turn`.
const ACCELERATION: f64 = 1.5;
/// Standard deviation of an unknown velocity, m/s, and so of one after a manoeuvre. Larger widens the gate of a new track.
const SPEED_STD: f64 = 8.0;
/// Time, s, within which an adopted velocity may have changed by the acceleration. Longer widens the gate after a missed frame.
const ADOPTED_S: f64 = 1.0;
/// Squared Mahalanobis innovation past which the beam has manoeuvred: χ² of two degrees exceeds it once in 3,000. Smaller loses
/// the velocity to noise, larger follows a jump later.
const MANOEUVRE: f64 = 16.0;

/// State (x, y, vx, vy) in m and m/s, white-noise acceleration (Bar-Shalom, Li and Kirubarajan, 2001, eqs. 6.2.2-10 to
/// 6.2.2-13).
#[derive(Clone, Debug)]
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

    /// Predicts the state `dt` seconds later.
    pub fn predict(&mut self, dt: f64) {
        let mut f = Matrix4::identity();
        f[(0, 2)] = dt;
        f[(1, 3)] = dt;
        self.state = f * self.state;
        let moved = f * self.cov * f.transpose();
        self.cov = 0.5 * (moved + moved.transpose());
        let (p, c, v) = (
            ACCELERATION * dt.powi(3) / 3.0,
            ACCELERATION * dt.powi(2) / 2.0,
            ACCELERATION * dt,
        );
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

    /// Takes a measured position, m, of covariance `r`, m². One far outside the prediction opens the filter first, so that it
    /// follows.
    pub fn update(&mut self, z: Vector2<f64>, r: Matrix2<f64>) {
        let innovation = z - self.position();
        if mahalanobis2(innovation, self.position_cov() + r) > MANOEUVRE {
            let spread = innovation.norm_squared();
            for k in 0..2 {
                self.cov[(k, k)] += spread;
                self.cov[(k + 2, k + 2)] = SPEED_STD * SPEED_STD;
            }
        }
        let s = self.position_cov() + r;
        let Some(inverse) = s.try_inverse() else {
            return;
        };
        let h = Matrix2x4::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0);
        let gain = self.cov * h.transpose() * inverse;
        self.state += gain * innovation;
        // Joseph's form stays positive whatever the rounding, and symmetric but for its last bits.
        let left = Matrix4::identity() - gain * h;
        let joseph = left * self.cov * left.transpose() + gain * r * gain.transpose();
        self.cov = 0.5 * (joseph + joseph.transpose());
    }

    /// Takes over a position, m, of covariance `r`, m², and a velocity, m/s, that hold all that was measured until now.
    pub fn adopt(&mut self, z: Vector2<f64>, r: Matrix2<f64>, velocity: Vector2<f64>) {
        *self = Self::start(z, r);
        for k in 0..2 {
            self.state[k + 2] = velocity[k];
            self.cov[(k + 2, k + 2)] = ACCELERATION * ADOPTED_S;
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
        filter.predict(1.0);
        // 1 + 8²·1² + 1.5/3, before the speed is bounded to 8 m/s again.
        let variance = 1.0 + 64.0 + 0.5;
        assert!((filter.position_cov()[(0, 0)] - variance).abs() < 1e-12);
        filter.update(Vector2::new(3.0, 0.0), Matrix2::identity());
        assert!((filter.position().x - 3.0 * variance / (variance + 1.0)).abs() < 1e-12);
        assert!((filter.position_cov()[(0, 0)] - variance / (variance + 1.0)).abs() < 1e-9);
    }

    #[test]
    fn follows_a_walker_and_a_turn() {
        let r = Matrix2::identity() * 0.01;
        let mut filter = KalmanFilter::start(Vector2::zeros(), r);
        let mut truth = Vector2::zeros();
        for k in 1..100 {
            let velocity = if k < 50 { 1.5 } else { -1.5 };
            truth.x += velocity * 0.1;
            filter.predict(0.1);
            filter.update(truth, r);
            let error = (filter.position() - truth).norm();
            assert!(error < 0.15, "frame {k}: {error}");
        }
        assert!((filter.velocity().x + 1.5).abs() < 0.1, "{}", filter.state);
    }

    #[test]
    fn a_jump_is_followed_at_once() {
        let r = Matrix2::identity() * 0.01;
        let mut filter = KalmanFilter::start(Vector2::zeros(), r);
        for _ in 0..50 {
            filter.predict(0.1);
            filter.update(Vector2::zeros(), r);
        }
        filter.predict(0.1);
        filter.update(Vector2::new(40.0, 0.0), r);
        assert!((filter.position().x - 40.0).abs() < 0.01);
    }

    #[test]
    fn a_long_gap_grows_no_faster_than_the_speed_bound() {
        let mut filter = KalmanFilter::start(Vector2::zeros(), Matrix2::identity());
        for _ in 0..100 {
            filter.predict(1.0);
        }
        assert!(filter.position_cov()[(0, 0)].sqrt() < 100.0 * SPEED_STD);
    }
}
