//! What the estimator makes of spots that are no Gaussians, without a calibration and with the shape known.

use std::f64::consts::{PI, TAU};
use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::measured::Measured;
use crate::estimate::{self, position_bound};
use crate::frame::Frame;
use crate::optics::spot::{Field, SpotShape, Template};
use crate::optics::{self, Camera};

/// Width that the estimator is told, pixels: the best Gaussian's of each kind, within 10 %.
const SIGMA: f64 = 2.1;
const PITCH_M: f64 = 0.03 / 64.0;
/// Samples a pixel along each axis.
const FINE: usize = 4;
/// Farther than this from every true spot, pixels, an emitter is invented; and so is a second one of the same spot.
const NEAR: f64 = 3.0;
/// Largest share of invented emitters, %, of separated spots on 64 × 64 pixels.
const MOST_INVENTED: f64 = 1.0;

/// Light per square pixel at an offset from the spot's centre, pixels, of a spot whose place is given in half sensors.
type Density = fn(x: f64, y: f64, u: [f64; 2]) -> f64;

const LENSES: [(&str, Density); 7] = [
    ("Gaussian", |x, y, _| gaussian(x, y, SIGMA)),
    ("Airy disc", |x, y, _| {
        let r = (x.hypot(y) * 3.8317 / (2.9 * SIGMA)).max(1e-9);
        (2.0 * libm::j1(r) / r).powi(2)
    }),
    ("Moffat, β 2.5", |x, y, _| {
        (1.0 + (x * x + y * y) / (2.05 * SIGMA).powi(2)).powf(-2.5)
    }),
    ("defocus disc", |x, y, _| {
        1.0 / (1.0 + ((x.hypot(y) - 1.8 * SIGMA) / 0.5).exp())
    }),
    ("coma, growing off axis", |x, y, [u, v]| {
        // Circles of the aperture's zones (Welford, 1986, ch. 8), blurred.
        let (size, far) = (1.2 * u.hypot(v), u.hypot(v).max(1e-9));
        let (along, across) = ((x * u + y * v) / far, (y * u - x * v) / far);
        let zone = |k: usize| {
            let (radius, angle) = (((k / 12) as f64 + 0.5) / 5.0, (k % 12) as f64 * TAU / 12.0);
            let centre = size * (2.0 * radius - 1.0);
            gaussian(
                along - centre - size * radius * angle.cos(),
                across - size * radius * angle.sin(),
                0.85 * SIGMA,
            )
        };
        (0..60).map(zone).sum()
    }),
    ("astigmatism at 45°", |x, y, _| {
        let [a, b] = [x + y, x - y].map(|d| d / 2f64.sqrt());
        (-0.5 * ((a / 2.5).powi(2) + (b / 1.8).powi(2))).exp()
    }),
    ("ghost of 2 %", |x, y, _| {
        gaussian(x, y, SIGMA) + 0.02 * gaussian(x - 9.0, y + 6.0, SIGMA)
    }),
];

fn gaussian(x: f64, y: f64, sigma: f64) -> f64 {
    (-0.5 * (x * x + y * y) / (sigma * sigma)).exp()
}

/// What came of the frames of one lens, SNR and layout.
#[derive(Default)]
struct Tally {
    spots: usize,
    missed: usize,
    invented: usize,
    /// Found positions within their 95 % ellipse.
    inside: usize,
    found: usize,
    /// Squared errors over the bound of the true spot.
    ratios: Vec<f64>,
    times_ms: Vec<f64>,
}

/// So many frames of each lens, peak SNR and layout.
pub fn lenses(frames: u64, seed: u64) -> Measured {
    let mut text = "| lens | SNR | invented %, missed %, in ellipse %, error over bound, median and longest ms: 64×64 apart | 64×64, pairs \
                    2 σ apart | 20×20 | 64×64 apart, shape known |\n|---|---|---|---|---|---|\n"
        .to_owned();
    let mut holds = true;
    for (name, density) in LENSES {
        for snr in [30.0, 100.0, 300.0, 1000.0] {
            let apart = measure(64, false, false, density, snr, frames, seed);
            holds &= 100.0 * apart.invented as f64 <= MOST_INVENTED * apart.spots as f64;
            let known = match name.starts_with("coma") {
                // Its shape depends on the place.
                true => "–".to_owned(),
                false => measure(64, false, true, density, snr, frames, seed).cell(),
            };
            let cells = [
                apart.cell(),
                measure(64, true, false, density, snr, frames, seed).cell(),
                measure(20, false, false, density, snr, frames, seed).cell(),
                known,
            ];
            writeln!(text, "| {name} | {snr} | {} |", cells.join(" | ")).expect("text takes all");
        }
    }
    Measured { text, holds }
}

fn measure(
    pixels: usize,
    is_paired: bool,
    is_known: bool,
    density: Density,
    snr: f64,
    frames: u64,
    seed: u64,
) -> Tally {
    let config = optics::Config {
        pixels: [pixels; 2],
        sensor_size_m: [PITCH_M * pixels as f64; 2],
        spot_sigma_m: Some(SIGMA * PITCH_M),
        ..Default::default()
    };
    let plain = config.camera().expect("a camera");
    let half = plain.x.half_width();
    let field = Field {
        half_sensor_m: [half; 2],
    };
    // The shape at the sensor's middle.
    let template = Template::of_density(field, 0.5 * PITCH_M, 14.0 * PITCH_M, |x, y| {
        density(x / PITCH_M, y / PITCH_M, [0.0; 2])
    });
    let shaped = Camera {
        spot_shape: SpotShape::from_template(&template, 1e-5).map(Arc::new),
        ..plain.clone()
    };
    let camera = if is_known { &shaped } else { &plain };
    let mut estimator = estimate::build(&estimate::Config::default(), camera).expect("an estimator");
    let noise = Normal::new(0.0, plain.noise_std_j).expect("a deviation");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut tally = Tally::default();
    for index in 0..frames {
        let spots = layout(pixels, is_paired, &mut rng);
        let mut frame = Array2::from_shape_simple_fn((pixels, pixels), || noise.sample(&mut rng));
        let mut energies = Vec::new();
        for &[x, y] in &spots {
            let scale = snr * rng.random_range(0.75..1.25) * plain.noise_std_j;
            let u = [x, y].map(|c| 2.0 * c / pixels as f64 - 1.0);
            let mut peak = 0.0f64;
            let spot = Array2::from_shape_fn((pixels, pixels), |(b, a)| {
                let mut sum = 0.0;
                for k in 0..FINE * FINE {
                    let [i, j] = [k % FINE, k / FINE].map(|s| (s as f64 + 0.5) / FINE as f64);
                    sum += density(a as f64 + i - x, b as f64 + j - y, u);
                }
                peak = peak.max(sum);
                sum
            });
            energies.push(spot.sum() / peak * scale);
            frame.scaled_add(scale / peak, &spot);
        }
        let frame = Frame {
            index,
            time: jiff::Timestamp::UNIX_EPOCH,
            pixels: frame,
            masked: None,
            exposure_s: None,
        };
        let clock = Instant::now();
        let estimate = estimator.estimate(&frame).expect("a frame that can be used");
        tally.times_ms.push(1e3 * clock.elapsed().as_secs_f64());
        let ground: Vec<_> = spots
            .iter()
            .map(|s| plain.to_ground(s.map(|c| c * PITCH_M - half)))
            .collect();
        let bounds = position_bound(&shaped, &ground, &energies);
        tally.count(
            &estimate.emitters,
            &ground,
            &bounds,
            NEAR * PITCH_M * plain.ground_scale(),
        );
    }
    tally
}

/// Centres, pixels from the sensor's corner: five apart, or three pairs; two or one on a small sensor.
fn layout(pixels: usize, is_paired: bool, rng: &mut ChaCha8Rng) -> Vec<[f64; 2]> {
    let (count, edge, apart) = match (pixels > 40, is_paired) {
        (true, false) => (5, 2.5, 6.0),
        (true, true) => (3, 4.0, 8.0),
        (false, _) => (2, 1.5, 4.0),
    };
    let mut places: Vec<[f64; 2]> = Vec::new();
    while places.len() < count {
        let next = [0, 1].map(|_| rng.random_range(edge * SIGMA..pixels as f64 - edge * SIGMA));
        if places
            .iter()
            .all(|p| (p[0] - next[0]).hypot(p[1] - next[1]) > apart * SIGMA)
        {
            places.push(next);
        }
    }
    if !is_paired {
        return places;
    }
    let halves = places.into_iter().flat_map(|p| {
        let (sin, cos) = rng.random_range(0.0..PI).sin_cos();
        [-SIGMA, SIGMA].map(|d| [p[0] + d * cos, p[1] + d * sin])
    });
    halves.collect()
}

impl Tally {
    fn count(&mut self, emitters: &[estimate::Emitter], truth: &[[f64; 2]], bounds: &[f64], near_m: f64) {
        let distance = |i: usize, j: usize| (emitters[j].x_m - truth[i][0]).hypot(emitters[j].y_m - truth[i][1]);
        let mut pairs: Vec<(f64, usize, usize)> = (0..truth.len())
            .flat_map(|i| (0..emitters.len()).map(move |j| (i, j)))
            .map(|(i, j)| (distance(i, j), i, j))
            .filter(|p| p.0 < near_m)
            .collect();
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut seen, mut used) = (vec![false; truth.len()], vec![false; emitters.len()]);
        for (d, i, j) in pairs {
            if seen[i] || used[j] {
                continue;
            }
            (seen[i], used[j]) = (true, true);
            let e = &emitters[j];
            let [dx, dy] = [e.x_m - truth[i][0], e.y_m - truth[i][1]];
            let [[a, b], [_, c]] = e.cov_m2;
            let square = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b);
            // The 95 % point of χ² with two degrees of freedom.
            self.inside += usize::from(square < 5.991);
            self.found += 1;
            self.ratios.push(d * d / bounds[i]);
        }
        self.spots += truth.len();
        self.missed += seen.iter().filter(|s| !**s).count();
        self.invented += used.iter().filter(|u| !**u).count();
    }

    /// A cell of the table.
    fn cell(mut self) -> String {
        let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
        self.times_ms.sort_by(f64::total_cmp);
        self.ratios.sort_by(f64::total_cmp);
        // Without the worst 5 %, as in the trade-off.
        let kept = &self.ratios[..self.ratios.len() * 19 / 20];
        let ratio = (kept.iter().sum::<f64>() / kept.len().max(1) as f64).sqrt();
        format!(
            "{:.1}, {:.1}, {:.0}, {ratio:.2}, {:.1}, {:.0}",
            percent(self.invented, self.spots),
            percent(self.missed, self.spots),
            percent(self.inside, self.found),
            self.times_ms[self.times_ms.len() / 2],
            self.times_ms[self.times_ms.len() - 1],
        )
    }
}
