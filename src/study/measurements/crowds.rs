//! What large sensors and many beams cost: size of the sensor and number of emitters against time, counts and errors.

use std::fmt::Write;
use std::time::Instant;

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::lens::bench::spot_shape;
use super::lens::shapes::AIRY;
use super::measured::Measured;
use crate::estimate::{self, Emitter, position_bound};
use crate::frame::Frame;
use crate::optics::{self, Camera, SpotError, add_spot};

/// Pixel pitch and width of a spot: 2.1 pixels, as on 64 × 64 pixels of the paper's sensor.
const PITCH_M: f64 = 0.03 / 64.0;
const SIGMA_M: f64 = 1e-3;
/// Peaks over the noise, evenly spread in the logarithm.
const PEAKS: [f64; 2] = [30.0, 300.0];
/// Least distance of two emitters, σ: all can be resolved.
const APART: f64 = 4.0;
/// Farther than this from every true spot, σ, an emitter is invented.
const NEAR: f64 = 1.5;
/// Emitters farther away than this, σ, do not change an emitter's bound.
const INDEPENDENT: f64 = 8.0;
/// Frames before the first that counts: searches are prepared for sizes of windows as they occur.
const WARM_UP: u64 = 5;

/// Whether the spot is a calibrated Airy disc or a Gaussian, pixels along x and y, number of emitters, and the median time allowed, ms, where
/// there is a requirement.
const CELLS: [(bool, [usize; 2], usize, Option<f64>); 14] = [
    (false, [64, 64], 9, None),
    (false, [256, 256], 9, None),
    (false, [256, 256], 80, Some(12.0)),
    (false, [512, 512], 0, None),
    (false, [512, 512], 9, None),
    (false, [512, 512], 80, None),
    (false, [512, 512], 200, Some(30.0)),
    (false, [1024, 1024], 9, None),
    (false, [1920, 1080], 9, Some(20.0)),
    (true, [64, 64], 9, None),
    (true, [512, 512], 0, None),
    (true, [512, 512], 9, None),
    (true, [512, 512], 80, None),
    (true, [1920, 1080], 9, None),
];
/// The spot error that a calibration from 150 frames finds for an Airy disc.
const SPOT_ERROR: f64 = 7e-3;
/// The 99th percentile of the time may be this many medians.
const MOST_SPREAD: f64 = 3.0;

#[derive(Default)]
struct Tally {
    spots: usize,
    frames_right: usize,
    missed: usize,
    invented: usize,
    /// Squared errors over the bound.
    ratios: Vec<f64>,
    times_ms: Vec<f64>,
}

/// So many frames of each size and number of emitters.
pub fn crowds(frames: u64, seed: u64) -> Measured {
    let mut text = "| spot | pixels | emitters | ms median | 99th | number right, % of frames | missed | invented | error over bound |\n|---|---|---|---|---|---|---|---|---|\n".to_owned();
    let mut holds = true;
    for (is_airy, pixels, count, most_ms) in CELLS {
        let mut tally = measure(is_airy, pixels, count, frames, seed);
        let ((median, late), error) = (tally.times(), tally.error());
        if let Some(most_ms) = most_ms {
            holds &= median <= most_ms && late <= MOST_SPREAD * median && tally.missed == 0;
        }
        writeln!(
            text,
            "| {} | {}×{} | {count} | {median:.2} | {late:.2} | {:.1} | {} of {} | {} | {error:.3} |",
            if is_airy { "Airy disc, calibrated" } else { "Gaussian" },
            pixels[0],
            pixels[1],
            100.0 * tally.frames_right as f64 / frames as f64,
            tally.missed,
            tally.spots,
            tally.invented,
        )
        .expect("text takes all");
    }
    Measured { text, holds }
}

fn measure(is_airy: bool, pixels: [usize; 2], count: usize, frames: u64, seed: u64) -> Tally {
    let config = optics::Config {
        pixels,
        sensor_size_m: pixels.map(|n| n as f64 * PITCH_M),
        spot_sigma_m: Some(SIGMA_M),
        ..Default::default()
    };
    let mut camera = config.camera().expect("a camera");
    if is_airy {
        camera.spot_shape = spot_shape(&AIRY, &camera, [0.0; 2]);
        camera.spot_error = SpotError::Fixed(SPOT_ERROR);
    }
    let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("an estimator");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut tally = Tally::default();
    for index in 0..frames + WARM_UP {
        let (places, energies) = emitters(&camera, count, &mut rng);
        let frame = Frame {
            index,
            time: jiff::Timestamp::UNIX_EPOCH,
            pixels: render(&camera, &places, &energies, &mut rng),
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        let (clock, start_ms) = (Instant::now(), cpu_ms());
        let found = estimator.estimate(&frame).expect("a frame that can be used").emitters;
        let elapsed_ms = 1e3 * clock.elapsed().as_secs_f64();
        if index >= WARM_UP {
            let on_cpu_ms = start_ms.zip(cpu_ms()).map(|(start, end)| end - start);
            tally.times_ms.push(on_cpu_ms.unwrap_or(elapsed_ms));
            tally.count(&camera, &places, &energies, &found);
        }
    }
    tally
}

/// Time that this thread has had a core, ms, which other programs on the cores do not lengthen; `None` but on Linux. The kernel brings the
/// figure up to date when the thread yields.
fn cpu_ms() -> Option<f64> {
    std::thread::yield_now();
    let figures = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    let nanoseconds: f64 = figures.split_whitespace().next()?.parse().ok()?;
    Some(1e-6 * nanoseconds)
}

/// Places on the sensor, m, and energies, J.
fn emitters(camera: &Camera, count: usize, rng: &mut ChaCha8Rng) -> (Vec<[f64; 2]>, Vec<f64>) {
    let mut places: Vec<[f64; 2]> = Vec::with_capacity(count);
    while places.len() < count {
        let next =
            [&camera.x, &camera.y].map(|axis| rng.random_range(axis.edge(0) + SIGMA_M..axis.edge(axis.n) - SIGMA_M));
        let is_apart = |p: &[f64; 2]| (p[0] - next[0]).hypot(p[1] - next[1]) > APART * SIGMA_M;
        if places.iter().all(is_apart) {
            places.push(next);
        }
    }
    // Of the energy a pixel at the centre holds ΔΦ², about pitch²/(2πσ²).
    let share = (PITCH_M / SIGMA_M).powi(2) / std::f64::consts::TAU;
    let energies = (0..count)
        .map(|_| rng.random_range(PEAKS[0].ln()..PEAKS[1].ln()).exp() * camera.noise_std_j / share)
        .collect();
    (places, energies)
}

fn render(camera: &Camera, places: &[[f64; 2]], energies: &[f64], rng: &mut ChaCha8Rng) -> Array2<f64> {
    let noise = |rng: &mut ChaCha8Rng| -> f64 { StandardNormal.sample(rng) };
    let mut pixels = Array2::from_shape_simple_fn(camera.shape(), || camera.noise_std_j * noise(rng));
    let line = pixels.as_slice_mut().expect("row by row");
    for (place, energy) in places.iter().zip(energies) {
        add_spot(camera, *place, *energy, line);
    }
    pixels
}

impl Tally {
    fn count(&mut self, camera: &Camera, places: &[[f64; 2]], energies: &[f64], found: &[Emitter]) {
        let mut used = vec![false; found.len()];
        let mut missed = 0;
        for (i, place) in places.iter().enumerate() {
            let distance = |e: &Emitter| (e.sensor_m[0] - place[0]).hypot(e.sensor_m[1] - place[1]);
            let nearest = (0..found.len())
                .filter(|&j| !used[j])
                .min_by(|&a, &b| distance(&found[a]).total_cmp(&distance(&found[b])))
                .filter(|&j| distance(&found[j]) < NEAR * SIGMA_M);
            let Some(j) = nearest else {
                missed += 1;
                continue;
            };
            used[j] = true;
            let truth = camera.to_ground(*place);
            let square = (found[j].x_m - truth[0]).powi(2) + (found[j].y_m - truth[1]).powi(2);
            self.ratios.push(square / bound(camera, i, places, energies));
        }
        let invented = used.iter().filter(|u| !**u).count();
        self.spots += places.len();
        self.frames_right += usize::from(missed == 0 && invented == 0);
        self.missed += missed;
        self.invented += invented;
    }

    fn times(&mut self) -> (f64, f64) {
        self.times_ms.sort_by(f64::total_cmp);
        let count = self.times_ms.len();
        (self.times_ms[count / 2], self.times_ms[(count * 99).div_ceil(100) - 1])
    }

    /// Root of the trimmed mean ratio, without the worst 5 % as in the trade-off.
    fn error(&mut self) -> f64 {
        self.ratios.sort_by(f64::total_cmp);
        let kept = &self.ratios[..self.ratios.len() * 19 / 20];
        (kept.iter().sum::<f64>() / kept.len().max(1) as f64).sqrt()
    }
}

/// The bound of emitter `i` from those near it, on a sensor of its own as far as they reach.
fn bound(camera: &Camera, i: usize, places: &[[f64; 2]], energies: &[f64]) -> f64 {
    let near = |j: &usize| (0..2).all(|k| (places[*j][k] - places[i][k]).abs() < INDEPENDENT * SIGMA_M);
    let order = std::iter::once(i).chain((0..places.len()).filter(|&j| j != i).filter(near));
    let (ground, energies): (Vec<_>, Vec<_>) = order.map(|j| (camera.to_ground(places[j]), energies[j])).unzip();
    let window = |axis: &optics::Axis, at: f64| {
        let reach = INDEPENDENT * SIGMA_M / PITCH_M;
        let middle = (at - axis.edge(0)) / axis.pitch_m;
        let (first, last) = (
            (middle - reach).max(0.0) as usize,
            ((middle + reach) as usize).min(axis.n),
        );
        optics::Axis {
            n: last - first,
            min_m: axis.edge(first),
            pitch_m: axis.pitch_m,
        }
    };
    let part = Camera {
        x: window(&camera.x, places[i][0]),
        y: window(&camera.y, places[i][1]),
        ..camera.clone()
    };
    position_bound(&part, &ground, &energies)[0]
}
