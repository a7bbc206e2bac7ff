//! The joint fit of device and frames: one set of device parameters, each frame's positions, energies and background
//! as nuisances that are eliminated frame by frame (bundle adjustment: Triggs, McLauchlan, Hartley and Fitzgibbon, 2000).

use faer::Mat;
use rayon::prelude::*;

use super::maps;
use super::shot::{Normal, PER_SPOT, Scaled, Shot, Spot};
use super::truth::Beacon;
use crate::optics::{Camera, Distortion, psf};

/// Distortion, ln σ_eff, spot growth.
const DEVICE: usize = Distortion::PARAMETERS + 2;
/// Mahalanobis distance past which a beacon's position is not believed.
const REJECT: f64 = 5.0;
/// Standard deviations of the residual that light without a spot must reach.
const SIGNIFICANT: f64 = 12.0;
/// A beacon is absent, and a source that nobody surveyed is modelled, below and above this share of the median energy.
const NOTABLE: f64 = 0.15;
const MAX_ROUNDS: usize = 24;

/// The fit's state.
pub struct Fit<'a> {
    pub camera: Camera,
    pub shots: Vec<Shot>,
    beacons: &'a [Beacon],
    /// Standard deviation of a surveyed position around its spot beyond what the pixel noise explains, squared,
    /// m² on the sensor.
    pub tether_m2: f64,
    prior: Prior,
    normals: Vec<Normal>,
}

/// Gaussian prior of the device parameters: generous next to real lenses, there to keep what few beacons cannot tell.
struct Prior {
    mean: [f64; DEVICE],
    std: [f64; DEVICE],
}

impl Prior {
    fn of(camera: &Camera) -> Self {
        let half = camera.x.half_width().min(camera.y.half_width());
        let r = camera.x.half_width().hypot(camera.y.half_width()) / camera.plane_distance_m;
        Self {
            mean: device_of(&Camera {
                distortion: Distortion::default(),
                spot_growth: 0.0,
                ..camera.clone()
            }),
            std: [
                0.1 * half,
                0.1 * half,
                0.1,
                0.1 / r.powi(2),
                0.05 / r.powi(4),
                0.02 / r.powi(6),
                0.02 / r,
                0.02 / r,
                0.3,
                0.3,
            ],
        }
    }

    fn cost(&self, device: &[f64; DEVICE]) -> f64 {
        (0..DEVICE)
            .map(|k| ((device[k] - self.mean[k]) / self.std[k]).powi(2))
            .sum()
    }
}

fn device_of(camera: &Camera) -> [f64; DEVICE] {
    let d = camera.distortion.parameters();
    std::array::from_fn(|k| match k {
        k if k < Distortion::PARAMETERS => d[k],
        k if k == Distortion::PARAMETERS => camera.spot_sigma_m.ln(),
        _ => camera.spot_growth,
    })
}

fn set_device(camera: &mut Camera, device: &[f64; DEVICE]) {
    camera.distortion = Distortion::from_parameters(std::array::from_fn(|k| device[k]));
    camera.spot_sigma_m = device[Distortion::PARAMETERS].exp();
    camera.spot_growth = device[Distortion::PARAMETERS + 1];
}

impl<'a> Fit<'a> {
    /// Sets up one shot a frame, with a spot wherever a beacon should be seen.
    pub fn new(camera: Camera, mut shots: Vec<Shot>, beacons: &'a [Beacon]) -> Self {
        for shot in &mut shots {
            shot.spots = beacons
                .iter()
                .enumerate()
                .filter(|(_, b)| b.frame == shot.frame && b.ground_m.iter().all(|v| v.is_finite()))
                .filter(|(_, b)| camera.sees(b.ground_m))
                .map(|(k, b)| {
                    let predicted_m = camera.to_sensor(b.ground_m);
                    Spot {
                        beacon: Some(k),
                        predicted_m,
                        sensor_m: predicted_m,
                        energy_j: 0.0,
                        trusted: true,
                    }
                })
                .collect();
        }
        let reach = 0.05 * camera.x.half_width().max(camera.y.half_width());
        Self {
            prior: Prior::of(&camera),
            camera,
            shots,
            beacons,
            tether_m2: reach * reach,
            normals: Vec::new(),
        }
    }

    /// Runs the whole fit. `progress` hears of each round: its number, the reduced χ² and the tether, m on the ground.
    pub fn run(&mut self, progress: &mut dyn FnMut(usize, f64, f64)) {
        let camera = &self.camera;
        self.shots.par_iter_mut().for_each(|shot| solve_energies(shot, camera));
        self.fit_shots(12);
        self.update_noise();
        self.tidy_spots();
        let mut quiet = 0;
        for round in 0..MAX_ROUNDS {
            let before = (device_of(&self.camera), self.camera.noise_std_j, self.tether_m2);
            self.judge_beacons();
            self.judge_shots();
            self.device_step();
            if round == 2 || round == 5 {
                self.tidy_spots();
            }
            self.update_noise();
            if round >= 2 {
                if let Some(maps) = maps::estimate(&self.camera, &self.shots) {
                    self.camera.pixels = Some(std::sync::Arc::new(maps));
                }
                self.fit_shots(3);
            }
            progress(
                round + 1,
                self.reduced_chi2(),
                self.tether_m2.sqrt() * self.camera.ground_scale(),
            );
            quiet = if self.has_settled(before) && round >= 6 {
                quiet + 1
            } else {
                0
            };
            if quiet == 2 {
                break;
            }
        }
        self.judge_beacons();
    }

    /// Median over the trusted frames.
    pub fn reduced_chi2(&self) -> f64 {
        median(
            self.shots
                .iter()
                .filter(|s| s.trusted)
                .map(|s| s.reduced_chi2(&self.camera))
                .collect(),
        )
        .unwrap_or(f64::NAN)
    }

    fn has_settled(&self, (device, noise, tether): ([f64; DEVICE], f64, f64)) -> bool {
        let r = self.camera.x.half_width();
        let now = device_of(&self.camera);
        let moved = (now[0] - device[0]).abs().max((now[1] - device[1]).abs());
        let (old, new) = (
            Distortion::from_parameters(std::array::from_fn(|k| device[k])),
            self.camera.distortion,
        );
        let z = self.camera.plane_distance_m;
        let corner = [r / z, self.camera.y.half_width() / z];
        let (a, b) = (old.project(z, corner), new.project(z, corner));
        let bent = (a[0] - b[0]).hypot(a[1] - b[1]);
        let small = 1e-5 * self.camera.x.pitch_m.max(1e-12);
        moved.max(bent) < 100.0 * small
            && (now[8] - device[8]).abs() < 1e-4
            && (noise / self.camera.noise_std_j - 1.0).abs() < 0.01
            && (tether / self.tether_m2 - 1.0).abs() < 0.1
    }

    fn fit_shots(&mut self, steps: usize) {
        let (camera, tether) = (&self.camera, self.tether_m2);
        self.normals = self
            .shots
            .par_iter_mut()
            .map(|shot| shot.fit(camera, tether, steps))
            .collect();
    }

    /// Total cost of the trusted frames.
    fn cost(&self) -> f64 {
        let shots = self.shots.iter().filter(|s| s.trusted);
        shots.map(|s| s.chi2 + s.tether_cost(self.tether_m2)).sum::<f64>() + self.prior.cost(&device_of(&self.camera))
    }

    /// One accepted Gauss–Newton step of the device, nuisances eliminated; damped until the cost falls.
    fn device_step(&mut self) {
        let (mut s, mut g) = (Mat::<f64>::zeros(DEVICE, DEVICE), vec![0.0; DEVICE]);
        let parts: Vec<_> = self
            .shots
            .par_iter()
            .zip(&self.normals)
            .filter(|(shot, _)| shot.trusted && !shot.spots.is_empty())
            .filter_map(|(shot, normal)| self.eliminated(shot, normal))
            .collect();
        for (block, rhs) in parts {
            s += block;
            g.iter_mut().zip(rhs).for_each(|(a, b)| *a += b);
        }
        let device = device_of(&self.camera);
        for k in 0..DEVICE {
            s[(k, k)] += self.prior.std[k].powi(-2);
            g[k] += (self.prior.mean[k] - device[k]) / self.prior.std[k].powi(2);
        }
        let cost = self.cost();
        let mut damping = 0.0;
        for _ in 0..6 {
            if let Some(solver) = Scaled::new(&s, damping) {
                let step = solver.solve(&g);
                let kept = (self.camera.clone(), self.shots.clone());
                let moved: [f64; DEVICE] = std::array::from_fn(|k| device[k] + step[k]);
                set_device(&mut self.camera, &moved);
                self.predict();
                self.fit_shots(4);
                if self.cost() <= cost {
                    return;
                }
                (self.camera, self.shots) = kept;
            }
            damping = if damping == 0.0 { 1e-3 } else { damping * 30.0 };
        }
        self.fit_shots(1);
    }

    /// Predicts every beacon's spot anew; the tether then pulls the spot along.
    fn predict(&mut self) {
        let (camera, beacons) = (&self.camera, self.beacons);
        for spot in self.shots.iter_mut().flat_map(|shot| &mut shot.spots) {
            if let Some(k) = spot.beacon {
                spot.predicted_m = camera.to_sensor(beacons[k].ground_m);
            }
        }
    }

    /// Schur complement of one frame: its share of the device's normal equations.
    fn eliminated(&self, shot: &Shot, normal: &Normal) -> Option<(Mat<f64>, Vec<f64>)> {
        let k = self.sensitivity(shot);
        let local = shot.local_columns();
        let (h, g_local) = shot.tethered(normal, self.tether_m2);
        let solver = Scaled::new(&h, 0.0)?;
        let gk = &normal.gram * &k;
        let cross = Mat::from_fn(local.len(), DEVICE, |a, b| gk[(local[a], b)]);
        let mut block = k.transpose() * &gk;
        block -= cross.transpose() * solver.solve_many(&cross);
        let eliminated = solver.solve(&g_local);
        let rhs = (0..DEVICE)
            .map(|b| {
                let direct: f64 = (0..k.nrows()).map(|c| k[(c, b)] * normal.rhs[c]).sum();
                direct - (0..local.len()).map(|a| cross[(a, b)] * eliminated[a]).sum::<f64>()
            })
            .collect();
        Some((block, rhs))
    }

    /// ∂(raw columns)/∂(device): where the device's parameters move the spots of a frame.
    fn sensitivity(&self, shot: &Shot) -> Mat<f64> {
        let rows = PER_SPOT * shot.spots.len() + shot.background.map_or(0, |b| b.len());
        let mut k = Mat::<f64>::zeros(rows, DEVICE);
        for (i, spot) in shot.spots.iter().enumerate() {
            if let Some(beacon) = spot.beacon.filter(|_| spot.trusted) {
                let tangents = self.camera.tangents(self.beacons[beacon].ground_m);
                let by = self
                    .camera
                    .distortion
                    .parameter_jacobian(self.camera.plane_distance_m, tangents);
                for axis in 0..2 {
                    for (p, value) in by[axis].iter().enumerate() {
                        k[(PER_SPOT * i + axis, p)] = *value;
                    }
                }
            }
            k[(PER_SPOT * i + 3, Distortion::PARAMETERS)] = self.camera.spot_sigma_at(spot.sensor_m);
            k[(PER_SPOT * i + 3, Distortion::PARAMETERS + 1)] =
                self.camera.spot_sigma_m * self.camera.corner_ratio2(spot.sensor_m);
        }
        k
    }

    /// Re-estimates the tether from how far the untethered spots lie from their beacons, and decides whom to believe.
    fn judge_beacons(&mut self) {
        let free: Vec<Vec<Option<Displacement>>> = self
            .shots
            .par_iter()
            .zip(&self.normals)
            .map(|(shot, normal)| displacements(shot, normal))
            .collect();
        let each = || {
            self.shots
                .iter()
                .zip(&free)
                .filter(|(s, _)| s.trusted)
                .flat_map(|(_, f)| f.iter().flatten())
        };
        let axes: Vec<(f64, f64)> = each()
            .flat_map(|d| (0..2).map(|k| (d.offset[k].powi(2), d.cov[k][k])))
            .collect();
        if axes.is_empty() {
            return;
        }
        let typical = median(axes.iter().map(|a| a.1).collect()).unwrap_or(0.0);
        self.tether_m2 = excess_variance(&axes).max(0.01 * typical).max(1e-22);
        let tether = self.tether_m2;
        for (shot, free) in self.shots.iter_mut().zip(free) {
            for (spot, d) in shot.spots.iter_mut().zip(free) {
                spot.trusted = d.is_some_and(|d| d.mahalanobis2(tether) < REJECT * REJECT);
            }
        }
    }

    /// A frame that is explained far worse than most has something in it that the fit does not know.
    fn judge_shots(&mut self) {
        let camera = &self.camera;
        let Some(typical) = median(self.shots.iter().map(|s| s.reduced_chi2(camera)).collect()) else {
            return;
        };
        for shot in &mut self.shots {
            shot.trusted = shot.reduced_chi2(camera) < 4.0 * typical.max(1.0);
        }
    }

    /// Drops spots without light and adds light without a spot, then fits again.
    fn tidy_spots(&mut self) {
        let energies: Vec<f64> = self.shots.iter().flat_map(|s| &s.spots).map(|s| s.energy_j).collect();
        let typical = median(energies).unwrap_or(0.0);
        let (camera, tether) = (&self.camera, self.tether_m2);
        self.shots
            .par_iter_mut()
            .zip(&mut self.normals)
            .for_each(|(shot, normal)| {
                for _ in 0..12 {
                    let kept = shot.spots.len();
                    drop_dark(shot, normal, tether, NOTABLE * typical);
                    let added = add_missing(shot, camera, NOTABLE * typical);
                    if shot.spots.len() == kept && !added {
                        break;
                    }
                    *normal = shot.fit(camera, tether, 6);
                }
            });
    }

    fn update_noise(&mut self) {
        let camera = &self.camera;
        let n = camera.x.n * camera.y.n;
        let residuals: Vec<f64> = self
            .shots
            .par_iter()
            .filter(|s| s.trusted)
            .flat_map_iter(|shot| {
                let mut r = vec![0.0; n];
                shot.residual(camera, &mut r);
                let used: Vec<f64> = r
                    .iter()
                    .zip(shot.used(camera))
                    .filter(|(_, u)| *u)
                    .map(|(r, _)| r.abs())
                    .collect();
                used
            })
            .collect();
        // Median of |r| of a Gaussian: 0.6745 σ.
        if let Some(m) = median(residuals).filter(|m| *m > 0.0) {
            self.camera.noise_std_j = m / 0.674_489_75;
        }
    }
}

/// How far an untethered spot lies from where its beacon puts it, m on the sensor.
#[derive(Clone, Copy)]
struct Displacement {
    offset: [f64; 2],
    cov: [[f64; 2]; 2],
}

impl Displacement {
    fn mahalanobis2(&self, tether: f64) -> f64 {
        let [[a, b], [_, c]] = self.cov;
        let (a, c) = (a + tether, c + tether);
        let [x, y] = self.offset;
        (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
    }
}

/// One Newton step without the tether, from the fitted state.
fn displacements(shot: &Shot, normal: &Normal) -> Vec<Option<Displacement>> {
    let local = shot.local_columns();
    let h = Mat::from_fn(local.len(), local.len(), |a, b| normal.gram[(local[a], local[b])]);
    let g: Vec<f64> = local.iter().map(|&c| normal.rhs[c]).collect();
    let Some(solver) = Scaled::new(&h, 0.0) else {
        return vec![None; shot.spots.len()];
    };
    let (step, inverse) = (
        solver.solve(&g),
        solver.solve_many(&Mat::identity(local.len(), local.len())),
    );
    let spots = shot.spots.iter().enumerate();
    spots
        .map(|(i, spot)| {
            spot.beacon?;
            let at = |a: usize, b: usize| inverse[(3 * i + a, 3 * i + b)];
            Some(Displacement {
                offset: std::array::from_fn(|k| spot.sensor_m[k] + step[3 * i + k] - spot.predicted_m[k]),
                cov: std::array::from_fn(|a| std::array::from_fn(|b| at(a, b))),
            })
        })
        .collect()
}

/// The variance T that makes the median of offset²/(cov + T) that of χ² with one degree of freedom.
fn excess_variance(axes: &[(f64, f64)]) -> f64 {
    const MEDIAN_CHI2: f64 = 0.454_936;
    let ratio = |t: f64| median(axes.iter().map(|(o2, c)| o2 / (c + t)).collect()).unwrap_or(0.0);
    if ratio(0.0) <= MEDIAN_CHI2 {
        return 0.0;
    }
    let (mut low, mut high) = (0.0, axes.iter().map(|a| a.0).fold(0.0, f64::max).max(1e-30) * 10.0);
    // In the logarithm first: the answer may lie many orders of magnitude below the largest offset.
    for _ in 0..200 {
        let middle = if low == 0.0 { high * 0.1 } else { (low * high).sqrt() };
        if ratio(middle) > MEDIAN_CHI2 {
            low = middle
        } else {
            high = middle
        }
        if low > 0.0 && high / low < 1.001 {
            break;
        }
    }
    (low * high).sqrt().max(low)
}

/// Energies and background with the positions held where they are: a linear problem.
fn solve_energies(shot: &mut Shot, camera: &Camera) {
    let n = shot.spots.len();
    let normal = shot.normal(camera);
    let linear: Vec<usize> = (0..n)
        .map(|i| PER_SPOT * i + 2)
        .chain(PER_SPOT * n..normal.rhs.len())
        .collect();
    let h = Mat::from_fn(linear.len(), linear.len(), |a, b| normal.gram[(linear[a], linear[b])]);
    let g: Vec<f64> = linear.iter().map(|&c| normal.rhs[c]).collect();
    if let Some(solution) = Scaled::new(&h, 1e-9).map(|s| s.solve(&g)) {
        for (spot, e) in shot.spots.iter_mut().zip(&solution) {
            spot.energy_j = *e;
        }
        if let Some(background) = &mut shot.background {
            background.copy_from_slice(&solution[n..]);
        }
    }
}

/// Drops the spots that surely have less energy than `least_j`: two that overlap may share theirs out at will.
fn drop_dark(shot: &mut Shot, normal: &Normal, tether_m2: f64, least_j: f64) {
    let (h, _) = shot.tethered(normal, tether_m2);
    let Some(solver) = Scaled::new(&h, 1e-12) else { return };
    let inverse = solver.solve_many(&Mat::identity(h.nrows(), h.nrows()));
    let mut i = 0;
    shot.spots.retain(|spot| {
        let std = inverse[(3 * i + 2, 3 * i + 2)].max(0.0).sqrt();
        i += 1;
        spot.energy_j + 3.0 * std > least_j
    });
}

/// Puts a spot without a beacon on the strongest light that the residual holds, if it is worth `least_j`.
fn add_missing(shot: &mut Shot, camera: &Camera, least_j: f64) -> bool {
    let (ny, nx) = camera.shape();
    let mut residual = vec![0.0; ny * nx];
    shot.residual(camera, &mut residual);
    let sigma = camera.spot_sigma_m;
    // Matched filter, one axis after the other: kernels centred on each pixel.
    let kernels = |axis: &crate::optics::Axis| -> Vec<Vec<f64>> {
        (0..axis.n)
            .map(|k| {
                let mut out = vec![0.0; axis.n];
                psf::profile(axis, axis.centre(k), sigma, &mut out);
                out
            })
            .collect()
    };
    let (kx, ky) = (kernels(&camera.x), kernels(&camera.y));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let along_x: Vec<Vec<f64>> = residual
        .chunks_exact(nx)
        .map(|row| kx.iter().map(|k| dot(k, row)).collect())
        .collect();
    let norms = |k: &[Vec<f64>]| k.iter().map(|k| dot(k, k)).collect::<Vec<f64>>();
    let (norm_x, norm_y) = (norms(&kx), norms(&ky));
    let mut best: Option<(f64, f64, [f64; 2])> = None;
    for (row, k) in ky.iter().enumerate() {
        for col in 0..nx {
            let product: f64 = k.iter().zip(&along_x).map(|(w, line)| w * line[col]).sum();
            let norm2 = norm_x[col] * norm_y[row];
            let strength = product / norm2.sqrt();
            if best.is_none_or(|b| strength > b.0) {
                best = Some((strength, product / norm2, [camera.x.centre(col), camera.y.centre(row)]));
            }
        }
    }
    let Some((strength, energy_j, sensor_m)) = best else {
        return false;
    };
    let apart = |s: &Spot| (s.sensor_m[0] - sensor_m[0]).hypot(s.sensor_m[1] - sensor_m[1]) > 1.5 * sigma;
    if strength < SIGNIFICANT * camera.noise_std_j || energy_j < least_j || !shot.spots.iter().all(apart) {
        return false;
    }
    shot.spots.push(Spot {
        beacon: None,
        predicted_m: sensor_m,
        sensor_m,
        energy_j,
        trusted: false,
    });
    true
}

/// The middle value; none of an empty list.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
