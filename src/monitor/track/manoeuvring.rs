//! A beam's position and velocity: it mostly goes straight on, and sometimes turns.

use nalgebra::{Matrix2, Vector2};

use super::kalman::KalmanFilter;

const MODES: usize = 2;
/// Spectral densities of the acceleration, m²/s³: of one who goes straight on, and of one who turns round within a second or two.
/// A larger first averages less, a smaller one lags behind who roams; a larger second follows a turn sooner, and a shaking
/// platform too.
const DENSITIES: [f64; MODES] = [0.01, 1.5];
/// How long each lasts, s, in the mean.
const LASTS_S: [f64; MODES] = [20.0, 2.0];
/// Squared Mahalanobis innovation past which no mode explains where the beam is: χ² of two degrees exceeds it once in 3,000.
/// Smaller loses the velocity to noise, larger follows a jump later.
const JUMP: f64 = 16.0;

/// The interacting multiple model filter of Blom and Bar-Shalom (1988): a Kalman filter for each way to go, mixed before each
/// frame by the probability that the beam has changed from one to the other.
#[derive(Clone, Debug)]
pub struct ManoeuvringFilter {
    modes: [KalmanFilter; MODES],
    probabilities: [f64; MODES],
    mixture: KalmanFilter,
    /// Covariance of what no measurement averages out, m².
    lasting: Matrix2<f64>,
}

impl ManoeuvringFilter {
    /// At a first measured position, m, of covariance `r`, m²; the velocity is unknown.
    pub fn start(z: Vector2<f64>, r: Matrix2<f64>) -> Self {
        let filter = KalmanFilter::start(z, r);
        Self {
            modes: [filter; MODES],
            probabilities: usual(),
            mixture: filter,
            lasting: Matrix2::zeros(),
        }
    }

    /// Predicts the state `dt` seconds later.
    pub fn predict(&mut self, dt: f64) {
        let rate: f64 = LASTS_S.iter().map(|lasts| 1.0 / lasts).sum();
        let forgotten = 1.0 - (-rate * dt).exp();
        let (usual, before) = (usual(), self.probabilities);
        let mixed: [_; MODES] = std::array::from_fn(|to| {
            let joint: [f64; MODES] = std::array::from_fn(|from| {
                let stays = if from == to { 1.0 - forgotten } else { 0.0 };
                before[from] * (stays + forgotten * usual[to])
            });
            let total: f64 = joint.iter().sum();
            let parts = joint.iter().zip(&self.modes);
            let mut filter = KalmanFilter::mixture(parts.map(|(p, filter)| (p / total, *filter)));
            filter.predict(dt, DENSITIES[to]);
            (total, filter)
        });
        self.probabilities = mixed.map(|(p, _)| p);
        self.modes = mixed.map(|(_, filter)| filter);
        self.mix();
    }

    /// Takes a measured position, m, of covariance `r`, m². One that no mode explains opens the filter first, so that it follows.
    pub fn update(&mut self, z: Vector2<f64>, r: Matrix2<f64>) {
        if self.modes.iter().all(|mode| mode.surprise(z, r) > JUMP) {
            self.modes.iter_mut().for_each(|mode| mode.open(z));
        }
        let ln_densities = self.modes.each_mut().map(|mode| mode.update(z, r));
        let most = ln_densities.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        // One that overflows tells nothing.
        if most.is_finite() {
            for (p, ln_density) in self.probabilities.iter_mut().zip(ln_densities) {
                *p *= (ln_density - most).exp();
            }
            let total: f64 = self.probabilities.iter().sum();
            self.probabilities = self.probabilities.map(|p| p / total);
        }
        self.mix();
    }

    /// Takes a measured position, m, whose error is one of covariance `r`, m², beside one of covariance `lasting` that it shares with
    /// those before.
    pub fn update_beside(&mut self, z: Vector2<f64>, r: Matrix2<f64>, lasting: Matrix2<f64>) {
        self.lasting = lasting;
        self.update(z, r);
    }

    /// Takes over a position, m, of covariance `r`, m², and a velocity, m/s, that hold all that was measured until now.
    pub fn adopt(&mut self, z: Vector2<f64>, r: Matrix2<f64>, velocity: Vector2<f64>) {
        self.modes.iter_mut().for_each(|mode| mode.adopt(z, r, velocity));
        self.lasting = Matrix2::zeros();
        self.mix();
    }

    /// Moves the state, m and m/s: the axes have moved, not the beam.
    pub fn shift(&mut self, by: Vector2<f64>, velocity: Vector2<f64>) {
        self.modes.iter_mut().for_each(|mode| mode.shift(by, velocity));
        self.mix();
    }

    pub fn position(&self) -> Vector2<f64> {
        self.mixture.position()
    }

    pub fn velocity(&self) -> Vector2<f64> {
        self.mixture.velocity()
    }

    pub fn position_cov(&self) -> Matrix2<f64> {
        self.mixture.position_cov() + self.lasting
    }

    fn mix(&mut self) {
        let parts = self.probabilities.iter().zip(&self.modes);
        self.mixture = KalmanFilter::mixture(parts.map(|(p, filter)| (*p, *filter)));
    }
}

/// The probabilities of the modes of a beam of which nothing is known.
fn usual() -> [f64; MODES] {
    LASTS_S.map(|lasts| lasts / LASTS_S.iter().sum::<f64>())
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::monitor::stats::gaussian::mahalanobis2;

    #[test]
    fn states_its_error_of_who_goes_straight_on() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let r = Matrix2::identity() * 0.01;
        let (mut normalised, mut squared, mut turning_squared) = (0.0, 0.0, 0.0);
        for _ in 0..100 {
            let mut measured = |k: i32| {
                let noise: [f64; 2] = [0; 2].map(|_| StandardNormal.sample(&mut rng));
                Vector2::new(0.12 * f64::from(k), 0.0) + Vector2::from(noise) * 0.1
            };
            let first = measured(0);
            let mut filter = ManoeuvringFilter::start(first, r);
            let mut turning = KalmanFilter::start(first, r);
            for k in 1..=100 {
                let z = measured(k);
                filter.predict(0.1);
                filter.update(z, r);
                turning.predict(0.1, DENSITIES[1]);
                turning.update(z, r);
            }
            let truth = Vector2::new(12.0, 0.0);
            normalised += mahalanobis2(filter.position() - truth, filter.position_cov()) / 200.0;
            squared += (filter.position() - truth).norm_squared();
            turning_squared += (turning.position() - truth).norm_squared();
        }
        assert!((0.6..1.1).contains(&normalised), "{normalised}");
        assert!(squared < 0.7 * turning_squared, "{squared} {turning_squared}");
    }

    #[test]
    fn an_error_that_lasts_is_not_averaged_out() {
        let r = Matrix2::identity() * 0.01;
        let mut filter = ManoeuvringFilter::start(Vector2::zeros(), r);
        for _ in 0..100 {
            filter.predict(0.1);
            filter.update_beside(Vector2::zeros(), r, 4.0 * r);
        }
        let variance = filter.position_cov()[(0, 0)];
        assert!((0.04..0.05).contains(&variance), "{variance}");
    }

    #[test]
    fn follows_a_walker_and_a_turn() {
        let r = Matrix2::identity() * 0.01;
        let mut filter = ManoeuvringFilter::start(Vector2::zeros(), r);
        let mut truth = Vector2::zeros();
        for k in 1..100 {
            let velocity = if k < 50 { 1.5 } else { -1.5 };
            truth.x += velocity * 0.1;
            filter.predict(0.1);
            filter.update(truth, r);
            let error = (filter.position() - truth).norm();
            // Turning round by 3 m/s between two frames, as nobody does, is believed in the second of them.
            let most = if (50..52).contains(&k) { 0.25 } else { 0.15 };
            assert!(error < most, "frame {k}: {error}");
        }
        assert!((filter.velocity().x + 1.5).abs() < 0.1, "{filter:?}");
    }

    #[test]
    fn a_jump_is_followed_at_once() {
        let r = Matrix2::identity() * 0.01;
        let mut filter = ManoeuvringFilter::start(Vector2::zeros(), r);
        for _ in 0..50 {
            filter.predict(0.1);
            filter.update(Vector2::zeros(), r);
        }
        filter.predict(0.1);
        filter.update(Vector2::new(40.0, 0.0), r);
        assert!((filter.position().x - 40.0).abs() < 0.01);
    }
}
