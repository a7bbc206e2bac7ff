//! The joint fit of device and frames: one set of device parameters, each frame's positions, energies and background
//! as nuisances that are eliminated frame by frame (bundle adjustment: Triggs, McLauchlan, Hartley and Fitzgibbon, 2000).

use faer::Mat;
use rayon::prelude::*;

use super::device::{DEVICE, Prior, device_of, set_device};
use super::exposure::{Exposure, NormalEquations, PER_SPOT, ScaledCholesky, Spot};
use super::maps;
use super::sources::{add_missing, background_strength, drop_dark, solve_energies};
use super::survey_residuals::{Displacement, displacements, excess_variance};
use super::truth::Beacon;
use crate::optics::{Camera, Distortion};
use crate::stats::median;

/// Mahalanobis distance beyond which a surveyed position is rejected. A position error is Gaussian to about here: 4·10⁻⁶ of
/// honest ones lie beyond (χ² with two degrees of freedom), while a swapped or mistyped one lies far beyond.
const REJECT_SIGMAS: f64 = 5.0;
/// Share of the median energy below which a spot is removed, and above which a residual is modelled as a source without a
/// surveyed position.
const SIGNIFICANT_SHARE: f64 = 0.15;
/// Background χ² (three degrees of freedom, median over the frames) above which a background is modelled; 1 % of frames without
/// one exceed it.
const BACKGROUND_CHI2: f64 = 11.3;
const MAX_ROUNDS: usize = 24;

/// State of the bundle adjustment.
pub struct Fit<'a> {
    pub camera: Camera,
    pub exposures: Vec<Exposure>,
    beacons: &'a [Beacon],
    /// Standard deviation of a surveyed position around its spot beyond what the pixel noise explains, squared,
    /// m² on the sensor.
    pub survey_var_m2: f64,
    prior: Prior,
    normals: Vec<NormalEquations>,
}

impl<'a> Fit<'a> {
    /// Places one spot for each beacon that the camera sees in its frame.
    pub fn new(camera: Camera, mut exposures: Vec<Exposure>, beacons: &'a [Beacon]) -> Self {
        for exposure in &mut exposures {
            exposure.spots = beacons
                .iter()
                .enumerate()
                .filter(|(_, b)| b.frame == exposure.frame && b.ground_m.iter().all(|v| v.is_finite()))
                .filter(|(_, b)| camera.sees(b.ground_m))
                .map(|(k, b)| {
                    let predicted_m = camera.to_sensor(b.ground_m);
                    Spot {
                        beacon: Some(k),
                        predicted_m,
                        sensor_m: predicted_m,
                        energy_j: 0.0,
                        is_inlier: true,
                    }
                })
                .collect();
        }
        let reach = 0.05 * camera.x.half_width().max(camera.y.half_width());
        Self {
            prior: Prior::of(&camera),
            camera,
            exposures,
            beacons,
            survey_var_m2: reach * reach,
            normals: Vec::new(),
        }
    }

    /// Runs the fit. `progress` is called after each round with its number, the reduced χ² and the standard deviation of the
    /// survey, m on the ground.
    pub fn run(&mut self, progress: &mut dyn FnMut(usize, f64, f64)) {
        let camera = &self.camera;
        self.exposures
            .par_iter_mut()
            .for_each(|exposure| solve_energies(exposure, camera));
        self.fit_exposures(12);
        self.select_background();
        self.update_noise();
        self.update_sources();
        let mut quiet = 0;
        for round in 0..MAX_ROUNDS {
            let before = (device_of(&self.camera), self.camera.noise_std_j, self.survey_var_m2);
            self.reject_outlying_beacons();
            self.reject_unexplained_exposures();
            self.device_step();
            if round == 2 || round == 5 {
                self.update_sources();
            }
            self.update_noise();
            if round >= 2 {
                if let Some(maps) = maps::estimate(&self.camera, &self.exposures) {
                    self.camera.pixels = Some(std::sync::Arc::new(maps));
                }
                self.fit_exposures(3);
            }
            progress(
                round + 1,
                self.reduced_chi2(),
                self.survey_var_m2.sqrt() * self.camera.ground_scale(),
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
        self.reject_outlying_beacons();
    }

    /// Median reduced χ² of the inlier frames.
    pub fn reduced_chi2(&self) -> f64 {
        median(
            self.exposures
                .iter()
                .filter(|s| s.is_inlier)
                .map(|s| s.reduced_chi2(&self.camera))
                .collect(),
        )
        .unwrap_or(f64::NAN)
    }

    fn has_settled(&self, (device, noise, survey_var): ([f64; DEVICE], f64, f64)) -> bool {
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
            && (survey_var / self.survey_var_m2 - 1.0).abs() < 0.1
    }

    fn fit_exposures(&mut self, steps: usize) {
        let (camera, survey_var) = (&self.camera, self.survey_var_m2);
        self.normals = self
            .exposures
            .par_iter_mut()
            .map(|exposure| exposure.fit(camera, survey_var, steps))
            .collect();
    }

    /// Total cost of the inlier frames and the device prior.
    fn cost(&self) -> f64 {
        let exposures = self.exposures.iter().filter(|s| s.is_inlier);
        exposures
            .map(|s| s.chi2 + s.survey_cost(self.survey_var_m2))
            .sum::<f64>()
            + self.prior.cost(&device_of(&self.camera))
    }

    /// One Gauss–Newton step of the device parameters with the nuisances eliminated; the damping grows until the cost falls.
    fn device_step(&mut self) {
        let (mut s, mut g) = (Mat::<f64>::zeros(DEVICE, DEVICE), vec![0.0; DEVICE]);
        let parts: Vec<_> = self
            .exposures
            .par_iter()
            .zip(&self.normals)
            .filter(|(exposure, _)| exposure.is_inlier && !exposure.spots.is_empty())
            .filter_map(|(exposure, normal)| self.eliminated(exposure, normal))
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
            if let Some(solver) = ScaledCholesky::new(&s, damping) {
                let step = solver.solve(&g);
                let kept = (self.camera.clone(), self.exposures.clone());
                let moved: [f64; DEVICE] = std::array::from_fn(|k| device[k] + step[k]);
                set_device(&mut self.camera, &moved);
                self.predict();
                self.fit_exposures(4);
                if self.cost() <= cost {
                    return;
                }
                (self.camera, self.exposures) = kept;
            }
            damping = if damping == 0.0 { 1e-3 } else { damping * 30.0 };
        }
        self.fit_exposures(1);
    }

    /// Updates the predicted position of every spot after a change of the device; the survey prior moves the spots with it.
    fn predict(&mut self) {
        let (camera, beacons) = (&self.camera, self.beacons);
        for spot in self.exposures.iter_mut().flat_map(|exposure| &mut exposure.spots) {
            if let Some(k) = spot.beacon {
                spot.predicted_m = camera.to_sensor(beacons[k].ground_m);
            }
        }
    }

    /// Schur complement of one frame: its contribution to the device's normal equations.
    fn eliminated(&self, exposure: &Exposure, normal: &NormalEquations) -> Option<(Mat<f64>, Vec<f64>)> {
        let k = self.sensitivity(exposure);
        let local = exposure.local_columns();
        let (h, g_local) = exposure.with_survey_prior(normal, self.survey_var_m2);
        let solver = ScaledCholesky::new(&h, 0.0)?;
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

    /// ∂(columns of the frame)/∂(device parameters).
    fn sensitivity(&self, exposure: &Exposure) -> Mat<f64> {
        let rows = PER_SPOT * exposure.spots.len() + exposure.background.map_or(0, |b| b.len());
        let mut k = Mat::<f64>::zeros(rows, DEVICE);
        for (i, spot) in exposure.spots.iter().enumerate() {
            if let Some(beacon) = spot.beacon.filter(|_| spot.is_inlier) {
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

    /// Re-estimates the survey variance from the displacements and rejects outlying surveyed positions.
    fn reject_outlying_beacons(&mut self) {
        let free: Vec<Vec<Option<Displacement>>> = self
            .exposures
            .par_iter()
            .zip(&self.normals)
            .map(|(exposure, normal)| displacements(exposure, normal))
            .collect();
        let each = || {
            self.exposures
                .iter()
                .zip(&free)
                .filter(|(s, _)| s.is_inlier)
                .flat_map(|(_, f)| f.iter().flatten())
        };
        let axes: Vec<(f64, f64)> = each()
            .flat_map(|d| (0..2).map(|k| (d.offset[k].powi(2), d.cov[k][k])))
            .collect();
        if axes.is_empty() {
            return;
        }
        let typical = median(axes.iter().map(|a| a.1).collect()).unwrap_or(0.0);
        self.survey_var_m2 = excess_variance(&axes).max(0.01 * typical).max(1e-22);
        let survey_var = self.survey_var_m2;
        for (exposure, free) in self.exposures.iter_mut().zip(free) {
            for (spot, d) in exposure.spots.iter_mut().zip(free) {
                spot.is_inlier = d.is_some_and(|d| d.mahalanobis2(survey_var) < REJECT_SIGMAS * REJECT_SIGMAS);
            }
        }
    }

    /// Removes the background from the model unless it is significant in most frames: with overlapping spots it costs accuracy.
    fn select_background(&mut self) {
        let survey_var = self.survey_var_m2;
        let strengths = self.exposures.par_iter().zip(&self.normals);
        let strengths = strengths.filter_map(|(exposure, normal)| background_strength(exposure, normal, survey_var));
        if median(strengths.collect()).is_some_and(|s| s > BACKGROUND_CHI2) {
            return;
        }
        self.exposures
            .iter_mut()
            .for_each(|exposure| exposure.background = None);
        self.fit_exposures(4);
    }

    /// Excludes frames whose reduced χ² is over four times the median: they hold something that the model lacks.
    fn reject_unexplained_exposures(&mut self) {
        let camera = &self.camera;
        let Some(typical) = median(self.exposures.iter().map(|s| s.reduced_chi2(camera)).collect()) else {
            return;
        };
        for exposure in &mut self.exposures {
            exposure.is_inlier = exposure.reduced_chi2(camera) < 4.0 * typical.max(1.0);
        }
    }

    /// Removes spots without light, adds sources where the residual is significant, and refits.
    fn update_sources(&mut self) {
        let energies: Vec<f64> = self
            .exposures
            .iter()
            .flat_map(|s| &s.spots)
            .map(|s| s.energy_j)
            .collect();
        let typical = median(energies).unwrap_or(0.0);
        let (camera, survey_var) = (&self.camera, self.survey_var_m2);
        self.exposures
            .par_iter_mut()
            .zip(&mut self.normals)
            .for_each(|(exposure, normal)| {
                for _ in 0..12 {
                    let kept = exposure.spots.len();
                    drop_dark(exposure, normal, survey_var, SIGNIFICANT_SHARE * typical);
                    let added = add_missing(exposure, camera, SIGNIFICANT_SHARE * typical);
                    if exposure.spots.len() == kept && !added {
                        break;
                    }
                    *normal = exposure.fit(camera, survey_var, 6);
                }
            });
    }

    fn update_noise(&mut self) {
        let camera = &self.camera;
        let n = camera.x.n * camera.y.n;
        let residuals: Vec<f64> = self
            .exposures
            .par_iter()
            .filter(|s| s.is_inlier)
            .flat_map_iter(|exposure| {
                let mut r = vec![0.0; n];
                exposure.residual(camera, &mut r);
                let used: Vec<f64> = r
                    .iter()
                    .zip(exposure.used(camera))
                    .filter(|(_, u)| *u)
                    .map(|(r, _)| r.abs())
                    .collect();
                used
            })
            .collect();
        // The median of |r| of a Gaussian is 0.6745 σ.
        if let Some(m) = median(residuals).filter(|m| *m > 0.0) {
            self.camera.noise_std_j = m / 0.674_489_75;
        }
    }
}
