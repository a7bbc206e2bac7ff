//! A device with a bent lens, a wrong width and uneven pixels, found again from frames with known positions.

use ndarray::Array2;
use oapwatch::calibrate::{self, truth::Beacon};
use oapwatch::optics::{Camera, Config, psf};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

/// The device as it is; the camera of the config is as it is said to be.
struct Device {
    camera: Camera,
    /// Share of the half-diagonal by which a corner is displaced; as r_d = r·(1 + bend·(r/R)²).
    bend: f64,
    gain: Array2<f64>,
}

fn config(n: usize, sigma: f64, noise: f64) -> Camera {
    Config {
        pixels: [n, n],
        spot_sigma_m: Some(sigma),
        noise_std_j: noise,
        ..Config::default()
    }
    .camera()
    .unwrap()
}

impl Device {
    fn new(said: &Camera, bend: f64, width_error: f64, gain_scatter: f64, rng: &mut impl Rng) -> Self {
        let scatter = Normal::new(1.0, gain_scatter).unwrap();
        Self {
            camera: Camera {
                spot_sigma_m: said.spot_sigma_m * (1.0 + width_error),
                ..said.clone()
            },
            bend,
            gain: Array2::from_shape_simple_fn(said.shape(), || scatter.sample(rng)),
        }
    }

    fn spot(&self, ground: [f64; 2]) -> [f64; 2] {
        let s = ground.map(|p| p * self.camera.plane_distance_m / self.camera.altitude_m);
        let r2 =
            (s[0] * s[0] + s[1] * s[1]) / (self.camera.x.half_width().powi(2) + self.camera.y.half_width().powi(2));
        s.map(|v| v * (1.0 + self.bend * r2))
    }

    fn frame(&self, emitters: &[([f64; 2], f64)], rng: &mut impl Rng) -> Array2<f64> {
        let noise = Normal::new(0.0, self.camera.noise_std_j).unwrap();
        let (ny, nx) = self.camera.shape();
        let mut out = Array2::zeros((ny, nx));
        let (mut fx, mut fy) = (vec![0.0; nx], vec![0.0; ny]);
        for &(ground, energy) in emitters {
            let [x, y] = self.spot(ground);
            psf::profile(&self.camera.x, x, self.camera.spot_sigma_m, &mut fx);
            psf::profile(&self.camera.y, y, self.camera.spot_sigma_m, &mut fy);
            for ((r, c), v) in out.indexed_iter_mut() {
                *v += energy * fy[r] * fx[c];
            }
        }
        out *= &self.gain;
        out.mapv_inplace(|v| v + noise.sample(rng));
        out
    }
}

#[test]
fn experiment() {
    let get = |k: &str, d: f64| std::env::var(k).ok().map_or(d, |v| v.parse().unwrap());
    let n = get("N", 20.0) as usize;
    let sigma = get("SIGMA", 2e-3);
    let noise = if get("PAPER", 0.0) > 0.0 {
        1e-6 * 2.0 * std::f64::consts::PI * sigma * sigma
    } else {
        1e-6
    };
    let frames = get("FRAMES", 60.0) as usize;
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let said = config(n, sigma, noise);
    let device = Device::new(
        &said,
        get("BEND", 0.02),
        get("WIDTH", 0.05),
        get("GAIN", 0.01),
        &mut rng,
    );
    let mut beacons = Vec::new();
    let mut pixels = Vec::new();
    let energy = Normal::new(0.0078, 0.0007).unwrap();
    for frame in 0..frames {
        let count = rng.random_range(5..=9);
        let emitters: Vec<([f64; 2], f64)> = (0..count)
            .map(|_| {
                (
                    [rng.random_range(-120.0..120.0), rng.random_range(-120.0..120.0)],
                    energy.sample(&mut rng),
                )
            })
            .collect();
        for (k, (ground_m, _)) in emitters.iter().enumerate() {
            let wrong = if rng.random_bool(get("WRONG", 0.0)) { 30.0 } else { 0.0 };
            if !rng.random_bool(get("MISSING", 0.0)) {
                beacons.push(Beacon {
                    frame,
                    ground_m: [ground_m[0] + wrong, ground_m[1]],
                    line: frame + 1 + 0 * k,
                });
            }
        }
        pixels.push(device.frame(&emitters, &mut rng));
    }
    let list: Vec<(usize, &Array2<f64>)> = pixels.iter().enumerate().collect();
    let t = std::time::Instant::now();
    let fitted = calibrate::fit(&said, &list, &beacons, &mut |round, chi2, tether| {
        eprintln!("round {round}: chi2 {chi2:.4} tether {tether:.5} m");
    });
    let c = &fitted.calibration;
    eprintln!("{:?} in {:?}", c.distortion, t.elapsed());
    eprintln!(
        "sigma ratio {} growth {} noise ratio {}",
        c.spot_sigma_m / device.camera.spot_sigma_m,
        c.spot_growth,
        c.noise_std_j / noise
    );
    eprintln!(
        "rejected {} of {}, unexplained {:?}",
        fitted.rejected.len(),
        beacons.len(),
        fitted.unexplained
    );
    let camera = c.applied_to(&said).unwrap();
    let half = said.x.half_width();
    for g in [0.0, 40.0, 80.0, 120.0] {
        let p = [g, 0.7 * g];
        let back = camera.to_ground(device.spot(p));
        eprintln!("at {p:?}: off by {:.2e} {:.2e} m", back[0] - p[0], back[1] - p[1]);
    }
    let _ = half;
    if let Some(maps) = &c.pixels {
        let e: Vec<f64> = maps.gain.iter().zip(&device.gain).map(|(a, b)| a - b).collect();
        let mean = e.iter().sum::<f64>() / e.len() as f64;
        let std = (e.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / e.len() as f64).sqrt();
        eprintln!(
            "gain error mean {mean:.2e} std {std:.2e}, bad {}",
            maps.bad.iter().filter(|b| **b).count()
        );
    }
}
