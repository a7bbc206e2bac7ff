//! How much an emitter accelerates, told by where frames have shown it.

use crate::estimate::sequence::course::{MANOEUVRE_M_S, SPEED_STD_M_S};

/// Spectral densities of an acceleration, m²/s³: from a course that the brightest emitter does not leave within a minute to sharp turns in every
/// second.
const DENSITIES_M2_S3: [f64; 13] = [
    1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0,
];
/// How long an emitter keeps one of them, s, and how much less likely than a density the next higher one is to follow. Where they are as likely,
/// faint emitters, of whom half a minute does not tell, lose what they have shown.
const KEPT_S: f64 = 30.0;
const RARER: f64 = 0.4;
/// Most that a coordinate counts, squared standard deviations: one frame may be wrong.
const MOST: f64 = 9.0;

/// A coordinate and its speed with their covariance, m and s.
#[derive(Clone, Copy, Debug, Default)]
struct Axis {
    place: f64,
    speed: f64,
    place_var: f64,
    both_cov: f64,
    speed_var: f64,
}

impl Axis {
    fn go_on(&mut self, dt: f64, density: f64) {
        self.place += dt * self.speed;
        self.place_var += dt * (2.0 * self.both_cov + dt * self.speed_var) + density * dt.powi(3) / 3.0;
        self.both_cov += dt * self.speed_var + density * dt * dt / 2.0;
        self.speed_var += density * dt;
    }

    /// Takes a measured place; −2 ln of its probability.
    fn see(&mut self, place: f64, variance: f64) -> f64 {
        let (innovation, expected) = (place - self.place, self.place_var + variance);
        let (gain, speed_gain) = (self.place_var / expected, self.both_cov / expected);
        self.place += gain * innovation;
        self.speed += speed_gain * innovation;
        self.speed_var -= speed_gain * self.both_cov;
        self.place_var *= 1.0 - gain;
        self.both_cov *= 1.0 - gain;
        expected.ln() + (innovation * innovation / expected).min(MOST)
    }
}

/// A bank of filters, one for each density, weighed by how well they foretell where the emitter is (Magill, 1965).
#[derive(Clone, Copy, Debug)]
pub(crate) struct AccelerationBank {
    courses: [[Axis; 2]; DENSITIES_M2_S3.len()],
    weights: [f64; DENSITIES_M2_S3.len()],
    seen_s: Option<f64>,
}

impl Default for AccelerationBank {
    fn default() -> Self {
        let mut weights = [0.0; DENSITIES_M2_S3.len()];
        weights[0] = 1.0;
        Self {
            courses: Default::default(),
            weights,
            seen_s: None,
        }
    }
}

impl AccelerationBank {
    /// Takes where the frame at `time_s` alone shows the emitter, m, with the variance of each coordinate, m².
    pub fn see(&mut self, place_m: [f64; 2], variance_m2: [f64; 2], time_s: f64) {
        let Some(seen_s) = self.seen_s.replace(time_s) else {
            let course = [0, 1].map(|k| Axis {
                place: place_m[k],
                place_var: variance_m2[k],
                speed_var: SPEED_STD_M_S.powi(2),
                ..Axis::default()
            });
            self.courses.fill(course);
            return;
        };
        let dt = time_s - seen_s;
        let changed = (dt / KEPT_S).min(0.5);
        let mut costs = [0.0; DENSITIES_M2_S3.len()];
        for ((course, cost), density) in self.courses.iter_mut().zip(&mut costs).zip(DENSITIES_M2_S3) {
            for (axis, (place, variance)) in course.iter_mut().zip(place_m.into_iter().zip(variance_m2)) {
                axis.go_on(dt, density);
                *cost += axis.see(place, variance);
            }
        }
        let least = costs.into_iter().fold(f64::INFINITY, f64::min);
        let mut share = changed * (1.0 - RARER);
        for (weight, cost) in self.weights.iter_mut().zip(costs) {
            *weight = ((1.0 - changed) * *weight + share) * (0.5 * (least - cost)).exp();
            share *= RARER;
        }
        let sum: f64 = self.weights.iter().sum();
        self.weights.iter_mut().for_each(|weight| *weight /= sum);
    }

    /// The emitter has changed its velocity at once.
    pub fn turn(&mut self) {
        for axis in self.courses.as_flattened_mut() {
            axis.speed_var += MANOEUVRE_M_S.powi(2);
        }
    }

    /// Spectral density of its acceleration along an axis, m²/s³: the weighted geometric mean.
    pub fn density_m2_s3(&self) -> f64 {
        let each = self.weights.iter().zip(DENSITIES_M2_S3);
        each.map(|(weight, density)| weight * density.ln()).sum::<f64>().exp()
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::AccelerationBank;

    /// The density found for this course, measured with these standard deviations, ten times a second for a minute.
    fn found(course: fn(f64) -> f64, std_m: fn(f64) -> f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut accelerations = AccelerationBank::default();
        for k in 0..600 {
            let t = 0.1 * f64::from(k);
            let place = [0, 1].map(|_| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                course(t) + std_m(t) * noise
            });
            accelerations.see(place, [std_m(t).powi(2); 2], t);
        }
        accelerations.density_m2_s3()
    }

    #[test]
    fn who_roams_is_restless_and_who_goes_straight_on_is_not() {
        let straight = found(|t| 1.3 * t - 7.0, |_| 0.1);
        assert!(straight < 1e-8, "{straight}");
        // Accelerations of 0.04 m/s² that change within some three seconds.
        let roams = found(|t| (0.3 * t).sin() - 2.0 * (0.2 * t).cos(), |_| 0.1);
        assert!((1e-3..1e-1).contains(&roams), "{roams}");
        let by_fading = found(|t| 1.3 * t, |t| 0.01 + 0.3 * (5.0 * t).sin().powi(2));
        assert!(by_fading < 1e-8, "{by_fading}");
    }

    #[test]
    fn a_turn_that_is_known_is_no_acceleration() {
        let after = |is_known: bool| {
            let mut accelerations = AccelerationBank::default();
            for k in 0..400 {
                let t = 0.1 * f64::from(k);
                if k == 200 && is_known {
                    accelerations.turn();
                }
                accelerations.see([(t - 20.0).abs(), 0.0], [0.01; 2], t);
            }
            accelerations.density_m2_s3()
        };
        let (known, unknown) = (after(true), after(false));
        assert!(known < 0.1 * unknown, "{known} {unknown}");
    }
}
