//! One frame of the fit: its spots, the residual that they leave, and the normal equations.

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::solvers::{Llt, Solve as _};
use faer::{Accum, Mat, Par, Side};

use crate::optics::spot::{Profile, SpotShape};
use crate::optics::{self, Axis, Camera, PixelMaps, psf};

/// One light source in one frame.
#[derive(Clone, Debug)]
pub struct Spot {
    /// Index of the beacon that the spot is assigned to; none for a source without a surveyed position.
    pub beacon: Option<usize>,
    /// Sensor position that the fitted geometry predicts for the beacon, m.
    pub predicted_m: [f64; 2],
    pub sensor_m: [f64; 2],
    pub energy_j: f64,
    /// Whether the beacon's position is used in the fit.
    pub is_inlier: bool,
}

/// One frame and its current model.
#[derive(Clone, Debug)]
pub struct Exposure {
    /// Frame number in the recording.
    pub frame: usize,
    /// Energies as recorded, J, row by row.
    pub pixels: Vec<f64>,
    /// Usable pixels: neither immense nor saturated.
    pub valid: Vec<bool>,
    pub spots: Vec<Spot>,
    /// Background: level per pixel, J, and its change from the array's centre to its edge in x and y; none when not modelled.
    pub background: Option<[f64; 3]>,
    /// Weighted squared residual of the last fit.
    pub chi2: f64,
    /// Whether the frame is used in the fit: its reduced χ² is not far above the median.
    pub is_inlier: bool,
}

/// Gauss–Newton normal equations of one frame in its raw columns: x, y, energy, σ of each spot, then the background.
pub struct NormalEquations {
    pub gram: Mat<f64>,
    pub rhs: Vec<f64>,
    pub chi2: f64,
}

/// Columns per spot in [`NormalEquations`].
pub const PER_SPOT: usize = 4;

impl Exposure {
    pub fn degrees_of_freedom(&self, camera: &Camera) -> f64 {
        let used = self.used(camera).filter(|&u| u).count();
        let fitted = 3 * self.spots.len() + self.background.map_or(0, |b| b.len());
        used.saturating_sub(fitted).max(1) as f64
    }

    pub fn reduced_chi2(&self, camera: &Camera) -> f64 {
        self.chi2 / self.degrees_of_freedom(camera)
    }

    /// Pixels used in the fit: valid in this frame and not marked as bad.
    pub fn used<'a>(&'a self, camera: &'a Camera) -> impl Iterator<Item = bool> + 'a {
        let bad = camera
            .pixels
            .as_deref()
            .map(|maps| maps.bad.as_slice().expect("maps are in standard layout"));
        self.valid
            .iter()
            .enumerate()
            .map(move |(p, &v)| v && bad.is_none_or(|bad| !bad[p]))
    }

    /// Writes the expected value of ideal pixels (unit gain, no dark level), J.
    pub fn ideal(&self, camera: &Camera, out: &mut [f64]) {
        let [level, slope_x, slope_y] = self.background.unwrap_or_default();
        for (p, value) in out.iter_mut().enumerate() {
            let [u, v] = unit_position(camera, p);
            *value = level + slope_x * u + slope_y * v;
        }
        for spot in &self.spots {
            optics::add_spot(camera, spot.sensor_m, spot.energy_j, out);
        }
    }

    /// Residual, recorded minus expected, J; zero for unused pixels.
    pub fn residual(&self, camera: &Camera, out: &mut [f64]) {
        self.ideal(camera, out);
        let (gain, dark) = maps(camera.pixels.as_deref());
        for (p, (value, used)) in out.iter_mut().zip(self.used(camera)).enumerate() {
            *value = if used {
                self.pixels[p] - dark(p) - gain(p) * *value
            } else {
                0.0
            };
        }
    }

    /// Normal equations of the frame at its current state, residuals in units of the noise.
    pub fn normal(&self, camera: &Camera) -> NormalEquations {
        let (ny, nx) = camera.shape();
        let n = ny * nx;
        let background = self.background.map_or(0, |b| b.len());
        let columns = PER_SPOT * self.spots.len() + background;
        let (gain, _) = maps(camera.pixels.as_deref());
        let weight: Vec<f64> = self
            .used(camera)
            .enumerate()
            .map(|(p, used)| if used { gain(p) / camera.noise_std_j } else { 0.0 })
            .collect();
        // The last column is the residual, so that one product gives the right-hand side and χ² too.
        let mut j = Mat::<f64>::zeros(n, columns + 1);
        let empty = psf::PixelResponse {
            fraction: 0.0,
            d_centre: 0.0,
            d_sigma: 0.0,
        };
        let (mut rx, mut ry) = (vec![empty; nx], vec![empty; ny]);
        for (i, spot) in self.spots.iter().enumerate() {
            if let Some(shape) = &camera.spot_shape {
                let columns = j.subcols_mut(PER_SPOT * i, PER_SPOT - 1);
                shape_columns(camera, shape, spot, &weight, columns);
                continue;
            }
            let sigma = camera.spot_sigma_at(spot.sensor_m);
            psf::profile_response(&camera.x, spot.sensor_m[0], sigma, &mut rx);
            psf::profile_response(&camera.y, spot.sensor_m[1], sigma, &mut ry);
            let e = spot.energy_j;
            let mut fill = |k: usize, value: &dyn Fn(&psf::PixelResponse, &psf::PixelResponse) -> f64| {
                let column = j.col_as_slice_mut(PER_SPOT * i + k);
                for (row, y) in ry.iter().enumerate() {
                    for (col, x) in rx.iter().enumerate() {
                        let p = row * nx + col;
                        column[p] = weight[p] * value(x, y);
                    }
                }
            };
            fill(0, &|x, y| e * x.d_centre * y.fraction);
            fill(1, &|x, y| e * x.fraction * y.d_centre);
            fill(2, &|x, y| x.fraction * y.fraction);
            fill(3, &|x, y| e * (x.d_sigma * y.fraction + x.fraction * y.d_sigma));
        }
        for k in 0..background {
            let column = j.col_as_slice_mut(columns - background + k);
            for (p, value) in column.iter_mut().enumerate() {
                let [u, v] = unit_position(camera, p);
                *value = weight[p] * [1.0, u, v][k];
            }
        }
        let residual = j.col_as_slice_mut(columns);
        self.residual(camera, residual);
        residual.iter_mut().for_each(|r| *r /= camera.noise_std_j);

        let mut gram = Mat::<f64>::zeros(columns + 1, columns + 1);
        triangular::matmul(
            &mut gram,
            BlockStructure::TriangularLower,
            Accum::Replace,
            j.transpose(),
            BlockStructure::Rectangular,
            &j,
            BlockStructure::Rectangular,
            1.0,
            Par::Seq,
        );
        let rhs = (0..columns).map(|k| gram[(columns, k)]).collect();
        let chi2 = gram[(columns, columns)];
        let gram = Mat::from_fn(
            columns,
            columns,
            |a, b| if a >= b { gram[(a, b)] } else { gram[(b, a)] },
        );
        NormalEquations { gram, rhs, chi2 }
    }

    /// Columns of the frame's own unknowns: all but the spots' σ, which the device fixes.
    pub fn local_columns(&self) -> Vec<usize> {
        let n = self.spots.len();
        let background = self.background.map_or(0, |b| b.len());
        (0..PER_SPOT * n + background)
            .filter(|c| *c >= PER_SPOT * n || c % PER_SPOT != 3)
            .collect()
    }

    /// Adds a step in the local columns.
    pub fn step(&mut self, local: &[f64]) {
        let n = self.spots.len();
        for (spot, d) in self.spots.iter_mut().zip(local.chunks_exact(3)) {
            spot.sensor_m[0] += d[0];
            spot.sensor_m[1] += d[1];
            spot.energy_j += d[2];
        }
        if let Some(background) = &mut self.background {
            background.iter_mut().zip(&local[3 * n..]).for_each(|(b, d)| *b += d);
        }
    }

    /// Sum over the inlier spots of the squared distance to the surveyed position, in units of `survey_var_m2`.
    pub fn survey_cost(&self, survey_var_m2: f64) -> f64 {
        let tied = self.spots.iter().filter(|s| s.is_inlier);
        tied.map(|s| (0..2).map(|k| (s.sensor_m[k] - s.predicted_m[k]).powi(2)).sum::<f64>() / survey_var_m2)
            .sum()
    }

    /// The local normal equations with the prior on inlier spots: N(surveyed position, `survey_var_m2`) per axis.
    pub fn with_survey_prior(&self, normal: &NormalEquations, survey_var_m2: f64) -> (Mat<f64>, Vec<f64>) {
        let local = self.local_columns();
        let mut h = Mat::from_fn(local.len(), local.len(), |a, b| normal.gram[(local[a], local[b])]);
        let mut g: Vec<f64> = local.iter().map(|&c| normal.rhs[c]).collect();
        for (i, spot) in self.spots.iter().enumerate().filter(|(_, s)| s.is_inlier) {
            for k in 0..2 {
                h[(3 * i + k, 3 * i + k)] += 1.0 / survey_var_m2;
                g[3 * i + k] += (spot.predicted_m[k] - spot.sensor_m[k]) / survey_var_m2;
            }
        }
        (h, g)
    }

    /// Levenberg–Marquardt on positions, energies and background with the device held fixed (Marquardt, 1963).
    /// Returns the normal equations at the end.
    pub fn fit(&mut self, camera: &Camera, survey_var_m2: f64, steps: usize) -> NormalEquations {
        let reach = 0.5 * camera.spot_sigma_m;
        let mut normal = self.normal(camera);
        let mut cost = normal.chi2 + self.survey_cost(survey_var_m2);
        let mut damping = 1e-4;
        for _ in 0..steps {
            let (h, g) = self.with_survey_prior(&normal, survey_var_m2);
            let Some(solver) = ScaledCholesky::new(&h, damping) else {
                damping *= 10.0;
                continue;
            };
            let mut step = solver.solve(&g);
            // The linearisation is not valid beyond about half a σ.
            let longest = step
                .chunks(3)
                .take(self.spots.len())
                .map(|d| d[0].hypot(d[1]))
                .fold(0.0, f64::max);
            if longest > reach {
                step.iter_mut().for_each(|d| *d *= reach / longest);
            }
            let mut trial = self.clone();
            trial.step(&step);
            trial.keep_in_reach(camera);
            let next = trial.normal(camera);
            let next_cost = next.chi2 + trial.survey_cost(survey_var_m2);
            if next_cost < cost {
                let gained = cost - next_cost;
                (*self, normal, cost) = (trial, next, next_cost);
                damping = (damping * 0.1).max(1e-12);
                if gained < 1e-3 + 1e-9 * cost {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
        self.chi2 = normal.chi2;
        normal
    }

    /// Keeps positions near the sensor: a spot far outside leaves no light that would constrain it.
    fn keep_in_reach(&mut self, camera: &Camera) {
        let margin = 2.0 * camera.spot_sigma_m;
        let limit = [camera.x.half_width() + margin, camera.y.half_width() + margin];
        for spot in &mut self.spots {
            for k in 0..2 {
                spot.sensor_m[k] = spot.sensor_m[k].clamp(-limit[k], limit[k]);
            }
        }
    }
}

/// Weighted derivatives of a measured spot by x, y and energy. Its width is not fitted: that column stays zero.
fn shape_columns(camera: &Camera, shape: &SpotShape, spot: &Spot, weight: &[f64], mut columns: faer::MatMut<'_, f64>) {
    let [u, v] = spot.sensor_m;
    // Fraction and derivative by the place, of every pixel.
    let along = |axis: &Axis, at: f64, profile: &Profile| -> Vec<[f64; 2]> {
        let edges: Vec<_> = (0..=axis.n).map(|k| profile.value(axis.edge(k) - at)).collect();
        edges
            .windows(2)
            .map(|e| [e[1].cumulative - e[0].cumulative, e[0].density - e[1].density])
            .collect()
    };
    for (k, (w, du, dv)) in shape.weights_at(u, v).enumerate() {
        let (fx, fy) = (
            along(&camera.x, u, shape.x_profile(k)),
            along(&camera.y, v, shape.y_profile(k)),
        );
        for (row, [y, y1]) in fy.iter().enumerate() {
            for (col, [x, x1]) in fx.iter().enumerate() {
                let p = row * camera.x.n + col;
                columns[(p, 0)] += weight[p] * spot.energy_j * (w * x1 + du * x) * y;
                columns[(p, 1)] += weight[p] * spot.energy_j * x * (w * y1 + dv * y);
                columns[(p, 2)] += weight[p] * w * x * y;
            }
        }
    }
}

/// Position of pixel `p` with the array's edges at ±1.
fn unit_position(camera: &Camera, p: usize) -> [f64; 2] {
    let (row, col) = (p / camera.x.n, p % camera.x.n);
    [
        camera.x.centre(col) / camera.x.half_width(),
        camera.y.centre(row) / camera.y.half_width(),
    ]
}

/// Gain and dark level of pixel `p`, of an ideal array when there are no maps.
pub fn maps(maps: Option<&PixelMaps>) -> (impl Fn(usize) -> f64 + '_, impl Fn(usize) -> f64 + '_) {
    let gain = maps.map(|m| m.gain.as_slice().expect("maps are in standard layout"));
    let dark = maps.map(|m| m.dark_j.as_slice().expect("maps are in standard layout"));
    (
        move |p: usize| gain.map_or(1.0, |g| g[p]),
        move |p: usize| dark.map_or(0.0, |d| d[p]),
    )
}

/// Cholesky factors of a normal matrix whose columns differ by many orders of magnitude.
pub struct ScaledCholesky {
    factors: Llt<f64>,
    scale: Vec<f64>,
}

impl ScaledCholesky {
    /// Factors H + damping·diag(H); none if that is not positive definite.
    pub fn new(h: &Mat<f64>, damping: f64) -> Option<Self> {
        let n = h.nrows();
        // A column without light gets a unit diagonal, which leaves its unknown unchanged.
        let scale: Vec<f64> = (0..n)
            .map(|k| if h[(k, k)] > 0.0 { h[(k, k)].sqrt().recip() } else { 0.0 })
            .collect();
        let scaled = Mat::from_fn(n, n, |a, b| {
            let unit = h[(a, b)] * scale[a] * scale[b];
            if a == b {
                if scale[a] > 0.0 { 1.0 + damping + 1e-13 } else { 1.0 }
            } else {
                unit
            }
        });
        let factors = scaled.llt(Side::Lower).ok()?;
        Some(Self { factors, scale })
    }

    pub fn solve(&self, rhs: &[f64]) -> Vec<f64> {
        let b = Mat::from_fn(rhs.len(), 1, |k, _| rhs[k] * self.scale[k]);
        let x = self.factors.solve(&b);
        (0..rhs.len()).map(|k| x[(k, 0)] * self.scale[k]).collect()
    }

    /// H⁻¹ B.
    pub fn solve_many(&self, b: &Mat<f64>) -> Mat<f64> {
        let scaled = Mat::from_fn(b.nrows(), b.ncols(), |r, c| b[(r, c)] * self.scale[r]);
        let x = self.factors.solve(&scaled);
        Mat::from_fn(b.nrows(), b.ncols(), |r, c| x[(r, c)] * self.scale[r])
    }
}
