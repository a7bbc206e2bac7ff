//! Flights that nobody chose: platform, light, rates and users drawn at random, of honest users alone.

use std::fmt::Write;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::measured::{Measured, exceptions};
use crate::estimate;
use crate::study::stories::pixels::{PixelStory, review};

const FLIGHT_S: f64 = 60.0;
/// Exposures, s; as long as from frame to frame where `None`. Every third flight has the same.
const EXPOSURES_S: [Option<f64>; 3] = [Some(0.01), Some(0.03), None];
/// Altitude at which users keep the distances below, m; at others they are as far apart on the sensor.
const ALTITUDE_M: f64 = 300.0;
/// Half the side of the square where users are, and how near they come to each other, m.
const HALF_SIDE_M: f64 = 60.0;
const APART_M: f64 = 22.0;

/// A flight's random numbers.
struct Draw(ChaCha8Rng);

impl Draw {
    fn one_of<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.0.random_range(0..values.len())]
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0.random_range(low..high)
    }

    fn normal(&mut self, std: f64) -> f64 {
        let z: f64 = StandardNormal.sample(&mut self.0);
        std * z
    }

    /// Everything but the users, and how fast the platform goes east and north, m/s.
    fn platform(&mut self, exposure_s: Option<f64>, altitude_m: f64) -> (String, [f64; 2]) {
        let size = altitude_m / ALTITUDE_M;
        let rate_hz = self.one_of(&[5.0, 10.0, 20.0]);
        let noise_j = self.one_of(&[3e-7, 1e-6]);
        let exposure_s = exposure_s.unwrap_or(1.0 / rate_hz);
        let [roll, pitch] = [0; 2].map(|_| self.between(-4.0, 4.0));
        let [yaw, heading] = [0; 2].map(|_| self.between(0.0, 360.0));
        let (sway, period_s) = (self.one_of(&[0.0, 1.0, 3.0, 5.0, 8.0]), self.between(4.0, 14.0));
        let (sway_y, period_y_s) = (sway * self.between(0.3, 1.0), period_s * self.between(0.7, 1.4));
        let turning = self.one_of(&[0.0, 0.0, 1.0, -2.0, 3.0, 6.0]);
        let (speed, way) = (
            self.one_of(&[0.0, size]) * self.between(0.2, 2.0),
            self.between(0.0, std::f64::consts::TAU),
        );
        let climb = size * self.one_of(&[0.0, 0.0, 0.5, -0.3]);
        let [east, north] = [speed * way.cos(), speed * way.sin()];
        let (radius_m, orbit_s) = (self.one_of(&[0.0, 0.0, 10.0]) * size, self.between(40.0, 120.0));
        let (attitude, place) = (self.one_of(&[0.005, 0.01, 0.026]), self.one_of(&[0.5, 1.0, 2.0]));
        let pose_hz = self.one_of(&[10.0, 20.0, 50.0, 100.0]);
        let (attitude_noise, place_noise) = (self.one_of(&[2e-4, 5e-4, 1e-3]), self.one_of(&[0.01, 0.02, 0.05]));
        let turned = [0.003, 0.003, attitude].map(|std| self.normal(std));
        let displaced = [place; 3].map(|std| self.normal(std));
        let delay_s = self.one_of(&[0.0, 0.01, 0.03, 0.06, 0.1]);
        let claims_m = self.one_of(&[0.2, 0.3, 1.0, 2.0]);
        let text = format!(
            "rate_hz = {rate_hz:?}\n\
             [optics]\naltitude_m = {altitude_m:?}\npixels = [64, 64]\nspot_sigma_m = 0.001\nnoise_std_j = {noise_j:?}\n\
             [link]\nintegration_time_s = {exposure_s:?}\n\
             [effects]\nattenuation = {{ kappa_per_m = 0.001 }}\nfading = {{ alpha = 4.0, beta = 2.0 }}\n\
             pointing = {{ jitter_m = 0.1 }}\nmotion_blur = {{}}\nthermal_noise = {{}}\n\
             [platform]\nmount = {{ roll_deg = {roll:?}, pitch_deg = {pitch:?}, yaw_deg = {yaw:?} }}\nheading_deg = {heading:?}\n\
             sway = {{ amplitude_deg = [{sway:?}, {sway_y:?}], period_s = [{period_s:?}, {period_y_s:?}] }}\n\
             yaw_rate_deg_s = {turning:?}\nvelocity_m_s = [{east:?}, {north:?}, {climb:?}]\n\
             orbit = {{ radius_m = {radius_m:?}, period_s = {orbit_s:?} }}\n\
             [platform.telemetry]\nrate_hz = {pose_hz:?}\nattitude_sigma_rad = {attitude:?}\nposition_sigma_m = {place:?}\n\
             attitude_noise_rad = {attitude_noise:?}\nposition_noise_m = {place_noise:?}\n\
             attitude_bias_rad = {turned:?}\nposition_bias_m = {displaced:?}\ndelay_s = {delay_s:?}\n\
             [claims]\nnoise_m = {claims_m:?}\nsigma_m = {claims_m:?}\n"
        );
        (text, [east, north])
    }

    /// Three to eight who stand, roam or walk about places that are in the middle of the view half-way through the flight.
    fn users(&mut self, size: f64, velocity_m_s: [f64; 2]) -> String {
        let count = self.one_of(&[3, 4, 5, 6, 8]);
        let mut homes: Vec<[f64; 2]> = Vec::new();
        while homes.len() < count {
            let at = [0; 2].map(|_| size * self.between(-HALF_SIDE_M, HALF_SIDE_M));
            if homes
                .iter()
                .all(|h| (h[0] - at[0]).hypot(h[1] - at[1]) > size * APART_M)
            {
                homes.push(at);
            }
        }
        let mut text = String::new();
        for (k, home) in homes.into_iter().enumerate() {
            let [x, y] = [0, 1].map(|i| home[i] + 0.5 * FLIGHT_S * velocity_m_s[i]);
            let corner = |dx: f64, dy: f64| [x + size * dx, y + size * dy];
            let motion = match self.one_of(&[0, 1, 2, 2]) {
                0 => format!("motion.still = [{x:?}, {y:?}]"),
                1 => format!("motion.roam = {{ home_m = [{x:?}, {y:?}], spread_m = 3, time_s = 15 }}"),
                _ => {
                    let through = [corner(-7.0, -5.0), corner(6.0, -6.0), corner(2.0, 7.0)];
                    let speed = self.between(0.8, 2.0);
                    format!("motion.walk = {{ through_m = {through:?}, speed_m_s = {speed:?} }}")
                }
            };
            writeln!(text, "[[user]]\nname = \"u-{k}\"\n{motion}").expect("text takes all");
        }
        text
    }
}

fn scene(seed: u64, exposure_s: Option<f64>) -> String {
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(seed ^ 0xa1e5));
    let altitude_m = draw.one_of(&[80.0, 150.0, 300.0, 300.0, 500.0]);
    let (platform, velocity_m_s) = draw.platform(exposure_s, altitude_m);
    platform + &draw.users(altitude_m / ALTITUDE_M, velocity_m_s)
}

/// `stories` flights of a minute, a third of them with each exposure.
pub fn flights(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let mut text = "| exposure | flights | with false alerts |\n|---|---|---|\n".to_owned();
    let mut all = Vec::new();
    for (of, exposure_s) in (0..).zip(EXPOSURES_S) {
        let seeds: Vec<u64> = (seed..seed + stories).filter(|k| k % 3 == of).collect();
        let flown = |k: &u64| {
            let mut story = PixelStory::of(*k, &scene(*k, exposure_s));
            story.seconds = FLIGHT_S;
            story.config.estimator = estimator.clone();
            (*k, review(&story).raised())
        };
        let mut raised: Vec<_> = seeds.par_iter().map(flown).collect();
        raised.retain(|(_, raised)| !raised.is_empty());
        let name = exposure_s.map_or("the whole frame".to_owned(), |s| format!("{} ms", 1e3 * s));
        writeln!(text, "| {name} | {} | {} |", seeds.len(), raised.len()).expect("text takes all");
        all.extend(raised);
    }
    text.push('\n');
    text.push_str(&exceptions(&all));
    Measured {
        text,
        holds: all.is_empty(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Plan, Scene};

    #[test]
    fn every_flight_can_be_simulated() {
        for seed in 0..60 {
            let text = scene(seed, EXPOSURES_S[seed as usize % 3]);
            let scene: Scene = toml::from_str(&text).expect("a scene");
            Plan::compile(&scene, seed).expect("a scene that can be simulated");
        }
    }
}
