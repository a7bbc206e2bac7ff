//! Runs the estimator on random frames and tallies its output.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use jiff::Timestamp;
use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};

use super::{Observed, Options, Worst};
use crate::estimate::{self, Error, Estimate, Flags};
use crate::frame::Frame;
use crate::optics::{Camera, Config, psf};
use crate::stats::mahalanobis2;

/// An emitter as it appears on the sensor.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    pub sensor_m: [f64; 2],
    pub energy_j: f64,
}

/// Truth and estimate of one frame.
#[derive(Debug)]
pub struct Sighting {
    pub truth: Vec<Source>,
    pub outcome: Result<Estimate, Error>,
}

/// Results over the frames of a case.
#[derive(Debug, Default)]
pub struct Tally {
    pub sightings: Vec<Sighting>,
    pub panics: usize,
    /// Malformed output, with its frame.
    pub faults: Vec<String>,
    pub worst: Worst,
}

/// A camera with σ_eff 1 mm over 3 cm unless changed; noise 1e-6 J.
pub fn camera(pixels: [usize; 2], sigma_m: f64) -> Camera {
    let config = Config {
        pixels,
        spot_sigma_m: Some(sigma_m),
        ..Config::default()
    };
    config.camera().expect("a valid camera")
}

/// Energy of an emitter whose fit has the given signal-to-noise ratio A‖f_x‖‖f_y‖/σ_n with the whole spot on the sensor.
pub fn energy(camera: &Camera, snr: f64) -> f64 {
    let norm = |axis: &crate::optics::Axis| {
        let mut row = vec![0.0; axis.n];
        let middle = axis.centre(axis.n / 2);
        psf::profile(axis, middle, camera.spot_sigma_m, &mut row);
        row.iter().map(|f| f * f).sum::<f64>().sqrt()
    };
    snr * camera.noise_std_j / (norm(&camera.x) * norm(&camera.y))
}

/// A uniformly random place on the sensor, at least `margin_m` inside its edges.
pub fn anywhere(camera: &Camera, margin_m: f64, rng: &mut ChaCha8Rng) -> [f64; 2] {
    [&camera.x, &camera.y].map(|axis| {
        let reach = (axis.half_width() - margin_m).max(0.0);
        (2.0 * Uniform::new(0.0, 1.0).expect("a range").sample(rng) - 1.0) * reach
    })
}

/// Exposes the sensor to `sources` with the camera's noise.
pub fn expose(camera: &Camera, sources: &[Source], rng: &mut ChaCha8Rng) -> Frame {
    let mut frame = noiseless(camera, sources);
    for pixel in &mut frame.pixels {
        let n: f64 = StandardNormal.sample(rng);
        *pixel += camera.noise_std_j * n;
    }
    frame
}

/// The expected frame.
pub fn noiseless(camera: &Camera, sources: &[Source]) -> Frame {
    let (ny, nx) = camera.shape();
    let mut pixels = Array2::zeros((ny, nx));
    let (mut fx, mut fy) = (vec![0.0; nx], vec![0.0; ny]);
    for source in sources {
        psf::profile(&camera.x, source.sensor_m[0], camera.spot_sigma_m, &mut fx);
        psf::profile(&camera.y, source.sensor_m[1], camera.spot_sigma_m, &mut fy);
        for ((y, x), pixel) in pixels.indexed_iter_mut() {
            *pixel += source.energy_j * fy[y] * fx[x];
        }
    }
    frame(pixels)
}

pub fn frame(pixels: Array2<f64>) -> Frame {
    Frame {
        index: 0,
        time: Timestamp::UNIX_EPOCH,
        pixels,
        masked: None,
        exposure_s: None,
        energy_scale: 1.0,
    }
}

/// Runs the estimator on `options.frames` frames that `make` draws.
pub fn observe(options: &Options, camera: &Camera, make: impl Fn(&mut ChaCha8Rng) -> (Frame, Vec<Source>)) -> Tally {
    let build = || estimate::build(&options.estimator, camera).expect("a known estimator");
    let mut estimator = build();
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut tally = Tally::default();
    for k in 0..options.frames {
        let (frame, truth) = make(&mut rng);
        let start = Instant::now();
        match catch_unwind(AssertUnwindSafe(|| estimator.estimate(&frame))) {
            Ok(outcome) => {
                let worst = &mut tally.worst;
                worst.time = worst.time.max(start.elapsed());
                if let Ok(estimate) = &outcome {
                    worst.condition = worst.condition.max(estimate.condition);
                    worst.steps = worst.steps.max(estimate.steps);
                    tally
                        .faults
                        .extend(faults(estimate).into_iter().map(|f| format!("frame {k}: {f}")));
                }
                tally.sightings.push(Sighting { truth, outcome });
            }
            Err(_) => {
                tally.panics += 1;
                estimator = build();
            }
        }
    }
    tally
}

/// Malformed values of an estimate: numbers that are not finite, invalid covariances.
pub fn faults(estimate: &Estimate) -> Vec<String> {
    let mut found = Vec::new();
    for (i, e) in estimate.emitters.iter().enumerate() {
        let [[a, b], [c, d]] = e.cov_m2;
        let numbers = [
            e.x_m,
            e.y_m,
            a,
            b,
            c,
            d,
            e.energy_j,
            e.energy_std_j,
            e.sensor_m[0],
            e.sensor_m[1],
        ];
        if !numbers.iter().all(|v| v.is_finite()) {
            found.push(format!("emitter {i} is not finite: {e:?}"));
        }
        // The determinant of a correlation matrix is off by its rounding, a few ulp of 1.
        let correlation2 = if b == 0.0 { 0.0 } else { (b / a) * (b / d) };
        if b != c || a < 0.0 || d < 0.0 || correlation2 > 1.0 + 1e-12 {
            found.push(format!(
                "emitter {i}'s covariance is not symmetric positive semi-definite: {:?}",
                e.cov_m2
            ));
        }
        if e.energy_j < 0.0 || e.energy_std_j < 0.0 {
            found.push(format!("emitter {i} has energy {} ± {}", e.energy_j, e.energy_std_j));
        }
    }
    if !(estimate.reduced_chi2 >= 0.0 && estimate.reduced_chi2.is_finite()) {
        found.push(format!("reduced χ² is {}", estimate.reduced_chi2));
    }
    if !(estimate.condition >= 1.0) {
        found.push(format!("the condition number is {}", estimate.condition));
    }
    if !(0.0..=1.0).contains(&estimate.saturated_share) {
        found.push(format!("saturated share is {}", estimate.saturated_share));
    }
    found
}

/// Flags that warn that the covariance of a position may be too small.
pub const WARNING: Flags = Flags::UNRESOLVED
    .union(Flags::NO_CONVERGENCE)
    .union(Flags::POOR_FIT)
    .union(Flags::OUT_OF_TIME)
    .union(Flags::ILL_CONDITIONED)
    .union(Flags::NON_GAUSSIAN);

impl Tally {
    /// Estimates of the frames that were not refused.
    pub fn estimates(&self) -> impl Iterator<Item = (&[Source], &Estimate)> {
        self.sightings
            .iter()
            .filter_map(|s| s.outcome.as_ref().ok().map(|e| (s.truth.as_slice(), e)))
    }

    pub fn refused(&self) -> usize {
        self.sightings.iter().filter(|s| s.outcome.is_err()).count()
    }

    /// Share of frames in which as many emitters were found as there were.
    pub fn share_counted(&self) -> f64 {
        let right = self.estimates().filter(|(t, e)| t.len() == e.emitters.len()).count();
        right as f64 / self.sightings.len().max(1) as f64
    }

    /// Fewest and most emitters found in a frame.
    pub fn counts(&self) -> (usize, usize) {
        let counts = || self.estimates().map(|(_, e)| e.emitters.len());
        (counts().min().unwrap_or(0), counts().max().unwrap_or(0))
    }

    /// Positions without a warning: how many there are, and how many of them lie more than `limit` standard deviations
    /// (Mahalanobis) from each of the `places` that the truth allows.
    pub fn strays(&self, camera: &Camera, limit: f64, places: impl Fn(&[Source]) -> Vec<[f64; 2]>) -> (usize, usize) {
        let (mut clean, mut stray) = (0, 0);
        for (truth, estimate) in self.estimates() {
            let places = places(truth);
            for e in estimate.emitters.iter().filter(|e| !e.flags.intersects(WARNING)) {
                clean += 1;
                let is_near = places.iter().any(|p| {
                    let [x, y] = camera.to_ground(*p);
                    mahalanobis2(e.cov_m2, [e.x_m - x, e.y_m - y]) <= limit * limit
                });
                stray += usize::from(!is_near);
            }
        }
        (clean, stray)
    }

    /// The outcome: the tally as text; it holds where `holds` is true and there are no panics and faults.
    pub fn observed(&self, holds: bool, remark: &str) -> Observed {
        let (least, most) = self.counts();
        let flagged = self
            .estimates()
            .flat_map(|(_, e)| &e.emitters)
            .filter(|e| e.flags.intersects(WARNING))
            .count();
        let mut happened = if least == most {
            format!("{least} found")
        } else {
            format!("{least} to {most} found")
        };
        if flagged > 0 {
            happened += &format!(", {flagged} with a warning");
        }
        if self.refused() > 0 {
            happened += &format!(", {} frames refused", self.refused());
        }
        if !remark.is_empty() {
            happened += &format!("; {remark}");
        }
        if self.panics > 0 {
            happened += &format!("; {} PANICS", self.panics);
        }
        if let Some(first) = self.faults.first() {
            happened += &format!("; {} FAULTS, the first: {first}", self.faults.len());
        }
        Observed {
            happened,
            holds: holds && self.panics == 0 && self.faults.is_empty(),
            fit: Some(self.worst),
        }
    }
}
