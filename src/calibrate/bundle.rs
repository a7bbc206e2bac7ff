//! The joint fit of device and frames: one set of device parameters, each frame's positions, energies and background
//! as nuisances that are eliminated frame by frame (bundle adjustment: Triggs, McLauchlan, Hartley and Fitzgibbon, 2000).

use faer::Mat;
use rayon::prelude::*;

use super::believe::{Displacement, displacements, excess_variance, median};
use super::device::{DEVICE, Prior, device_of, set_device};
use super::maps;
use super::shot::{Normal, PER_SPOT, Scaled, Shot, Spot};
use super::sources::{add_missing, background_strength, drop_dark, solve_energies};
use super::truth::Beacon;
use crate::optics::{Camera, Distortion};

/// Mahalanobis distance past which a beacon's position is not believed.
const REJECT: f64 = 5.0;
/// A beacon is absent, and a source that nobody surveyed is modelled, below and above this share of the median energy.
const NOTABLE: f64 = 0.15;
/// Median over the frames of the background's χ² of three degrees of freedom from which one is modelled; 1 % exceed it by chance.
const BACKGROUND: f64 = 11.3;
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
        self.judge_background();
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

    /// Leaves the background out of all frames unless most show one: under melted spots it costs accuracy.
    fn judge_background(&mut self) {
        let tether = self.tether_m2;
        let strengths = self.shots.par_iter().zip(&self.normals);
        let strengths = strengths.filter_map(|(shot, normal)| background_strength(shot, normal, tether));
        if median(strengths.collect()).is_some_and(|s| s > BACKGROUND) {
            return;
        }
        self.shots.iter_mut().for_each(|shot| shot.background = None);
        self.fit_shots(4);
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
