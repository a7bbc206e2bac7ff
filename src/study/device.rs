//! A device with a bent lens, a wrong width and uneven pixels, which the calibration must find from frames with known positions.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use nalgebra::DMatrix;
use ndarray::Array2;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, Normal};

use crate::assign::assign;
use crate::frames::npy;
use crate::optics::{Camera, Config, psf};

/// Pixels a side.
pub const N: usize = 20;
/// σ of a spot as the config has it, m.
pub const SIGMA_M: f64 = 2e-3;
/// Noise of a pixel, unless another is asked for, J.
pub const NOISE_J: f64 = 1e-6;

/// Places on the ground, m, and energies, J.
pub type Emitters = Vec<([f64; 2], f64)>;

/// The device as it is, which its config does not know.
pub struct Device {
    pub camera: Camera,
    /// A corner is displaced by this share of its radius: r_d = r·(1 + bend·(r/R)²).
    bend: f64,
    gain: Array2<f64>,
    /// Even light on all pixels, J.
    pub light_j: f64,
}

impl Device {
    pub fn new(noise_j: f64, bend: f64, width_error: f64, gain_scatter: f64, rng: &mut impl Rng) -> Self {
        let optics = Config {
            pixels: [N, N],
            spot_sigma_m: Some(SIGMA_M * (1.0 + width_error)),
            noise_std_j: noise_j,
            ..Config::default()
        };
        let scatter = Normal::new(1.0, gain_scatter).expect("a standard deviation");
        Self {
            camera: optics.camera().expect("a camera"),
            bend,
            gain: Array2::from_shape_simple_fn((N, N), || scatter.sample(rng)),
            light_j: 0.0,
        }
    }

    fn spot(&self, ground: [f64; 2]) -> [f64; 2] {
        let s = ground.map(|p| p * self.camera.plane_distance_m / self.camera.altitude_m);
        let corner2 = 2.0 * self.camera.x.half_width().powi(2);
        s.map(|v| v * (1.0 + self.bend * (s[0] * s[0] + s[1] * s[1]) / corner2))
    }

    /// Pixels without noise, and their derivatives by each emitter's sensor position and energy.
    fn expose(&self, emitters: &Emitters) -> (Array2<f64>, Vec<Array2<f64>>) {
        let (camera, mut total, mut columns) = (&self.camera, Array2::zeros((N, N)), Vec::new());
        let zero = psf::PixelResponse {
            fraction: 0.0,
            d_centre: 0.0,
            d_sigma: 0.0,
        };
        for &(ground, energy) in emitters {
            let [x, y] = self.spot(ground);
            let (mut fx, mut fy) = (vec![zero; N], vec![zero; N]);
            psf::profile_response(&camera.x, x, camera.spot_sigma_m, &mut fx);
            psf::profile_response(&camera.y, y, camera.spot_sigma_m, &mut fy);
            let map = |f: &dyn Fn(&psf::PixelResponse, &psf::PixelResponse) -> f64| {
                Array2::from_shape_fn((N, N), |(r, c)| self.gain[[r, c]] * f(&fx[c], &fy[r]))
            };
            columns.push(map(&|x, y| energy * x.d_centre * y.fraction));
            columns.push(map(&|x, y| energy * x.fraction * y.d_centre));
            columns.push(map(&|x, y| x.fraction * y.fraction));
            total = total + map(&|x, y| energy * x.fraction * y.fraction);
        }
        (total, columns)
    }

    fn frame(&self, emitters: &Emitters, rng: &mut impl Rng) -> Array2<f64> {
        let noise = Normal::new(0.0, self.camera.noise_std_j).expect("a standard deviation");
        let light = self.gain.mapv(|g| g * self.light_j);
        (self.expose(emitters).0 + light).mapv(|v| v + noise.sample(rng))
    }

    /// Cramér–Rao bound of each position, both axes summed, m² on the ground of the undistorted scale (the distortion
    /// changes that by a few per cent at most).
    fn bound(&self, emitters: &Emitters) -> Vec<f64> {
        let (_, columns) = self.expose(emitters);
        let j = DMatrix::from_fn(N * N, columns.len(), |p, k| {
            columns[k][[p / N, p % N]] / self.camera.noise_std_j
        });
        // Columns in m and in J differ by orders of magnitude: scale them before inverting.
        let scale: Vec<f64> = j.column_iter().map(|c| 1.0 / c.norm()).collect();
        let scaled = DMatrix::from_fn(j.nrows(), j.ncols(), |r, c| j[(r, c)] * scale[c]);
        let inverse = (scaled.transpose() * scaled)
            .try_inverse()
            .expect("emitters stand apart");
        let ground2 = self.camera.ground_scale().powi(2);
        (0..emitters.len())
            .map(|i| {
                (0..2)
                    .map(|k| inverse[(3 * i + k, 3 * i + k)] * scale[3 * i + k].powi(2))
                    .sum::<f64>()
                    * ground2
            })
            .collect()
    }
}

/// Emitters at least 25 m apart, so that what is measured is the calibration and not who can be told apart.
fn emitters(rng: &mut impl Rng) -> Emitters {
    let energy = Normal::new(0.0078, 0.0007).expect("a standard deviation");
    let mut out: Emitters = Vec::new();
    let count = rng.random_range(5..=7);
    while out.len() < count {
        let at = [rng.random_range(-118.0..118.0), rng.random_range(-118.0..118.0)];
        if out.iter().all(|(p, _)| (p[0] - at[0]).hypot(p[1] - at[1]) > 25.0) {
            out.push((at, energy.sample(rng)));
        }
    }
    out
}

/// Frames of this device in a file, and the emitters of each.
pub fn record(dir: &Path, name: &str, device: &Device, frames: usize, rng: &mut impl Rng) -> (PathBuf, Vec<Emitters>) {
    let path = dir.join(name);
    let mut writer = npy::Writer::create(&path, (N, N)).expect("a folder to write to");
    let scenes: Vec<Emitters> = (0..frames).map(|_| emitters(rng)).collect();
    for scene in &scenes {
        writer.push(device.frame(scene, rng).view()).expect("room on the disk");
    }
    (path, scenes)
}

/// The survey of these scenes, off by `shift` (frame, emitter), m.
pub fn write_truth(path: &Path, scenes: &[Emitters], shift: impl Fn(usize, usize) -> f64) {
    let lines = scenes.iter().enumerate().map(|(frame, scene)| {
        let list = scene.iter().enumerate();
        let list: Vec<_> = list
            .map(|(k, (p, _))| serde_json::json!({"x_m": p[0] + shift(frame, k), "y_m": p[1]}))
            .collect();
        format!("{}\n", serde_json::json!({"frame": frame, "emitters": list}))
    });
    std::fs::write(path, lines.collect::<String>()).expect("a folder to write to");
}

/// A config of the device as it is thought to be, with its calibration.
pub fn write_config(path: &Path, noise_j: f64, calibration: Option<&str>) {
    let line = calibration
        .map(|c| format!("calibration = \"{c}\"\n"))
        .unwrap_or_default();
    let text = format!("[optics]\npixels = [{N}, {N}]\nspot_sigma_m = {SIGMA_M}\nnoise_std_j = {noise_j}\n{line}");
    std::fs::write(path, text).expect("a folder to write to");
}

/// Runs a command of `program`.
pub fn run(program: &Path, args: &[&dyn AsRef<OsStr>]) -> Output {
    let mut command = Command::new(program);
    args.iter().for_each(|a| {
        command.arg(a);
    });
    command.output().expect("the program runs")
}

pub fn calibrate(program: &Path, config: &Path, truth: &Path, out: &Path, frames: &Path) -> Output {
    let args: [&dyn AsRef<OsStr>; 8] = [
        &"calibrate",
        &"--config",
        &config,
        &"--truth",
        &truth,
        &"--out",
        &out,
        &frames,
    ];
    run(program, &args)
}

/// Mean squared error of `locate` over matched pairs, m², over the mean bound of the same emitters; and how many of all
/// emitters were found.
pub fn error_over_bound(
    program: &Path,
    config: &Path,
    frames: &Path,
    device: &Device,
    scenes: &[Emitters],
) -> (f64, f64) {
    let out = run(program, &[&"locate", &"--config", &config, &frames]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let (mut squared, mut bound, mut found, mut total) = (0.0, 0.0, 0, 0);
    for (line, scene) in String::from_utf8_lossy(&out.stdout).lines().zip(scenes) {
        let line: serde_json::Value = serde_json::from_str(line).expect("a line of locate");
        let emitters = line["emitters"].as_array().expect("a list of emitters");
        let at: Vec<[f64; 2]> = emitters
            .iter()
            .map(|e| ["x_m", "y_m"].map(|k| e[k].as_f64().expect("a number")))
            .collect();
        let distance2 = |t: usize, e: usize| (scene[t].0[0] - at[e][0]).powi(2) + (scene[t].0[1] - at[e][1]).powi(2);
        let bounds = device.bound(scene);
        total += scene.len();
        for (t, e) in assign(scene.len(), at.len(), 625.0, distance2).pairs {
            squared += distance2(t, e);
            bound += bounds[t];
            found += 1;
        }
    }
    (squared / bound, f64::from(found) / total as f64)
}

/// Calibrates on `frames` of the device as they are surveyed; `plain.toml` and `calibrated.toml` in `dir` are without and with
/// what came of it. What was said.
pub fn calibrated(
    program: &Path,
    dir: &Path,
    device: &Device,
    frames: usize,
    rng: &mut impl Rng,
    shift: impl Fn(usize, usize) -> f64,
) -> String {
    let at = |name: &str| dir.join(name);
    let (recorded, scenes) = record(dir, "beacons.npy", device, frames, rng);
    write_truth(&at("truth.ndjson"), &scenes, shift);
    let noise_j = device.camera.noise_std_j;
    write_config(&at("plain.toml"), noise_j, None);
    // The config may name the calibration before it is there.
    write_config(&at("calibrated.toml"), noise_j, Some("calibration.toml"));
    let out = calibrate(
        program,
        &at("calibrated.toml"),
        &at("truth.ndjson"),
        &at("calibration.toml"),
        &recorded,
    );
    let text = String::from_utf8_lossy(&out.stdout).into_owned() + &String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{text}");
    text
}
