//! The joint fit of all emitters and nuisances to one reading: Levenberg–Marquardt in separable form.
//!
//! A frame is F_y·diag(A)·F_xᵀ, so a residual costs O(m² N) and the normal equations are Hadamard products of small
//! Gram matrices, O(m N²) (Golub and Pereyra, 1973, for separable least squares). Steps carry geodesic acceleration
//! (Transtrum and Sethna, 2012, eq. 14), amplitudes are solved anew at each trial, and unusable pixels are taken out of
//! the normal equations one by one, which is exact whatever they were filled with.

use super::basis::Basis;
use super::linear::{axpy, cholesky, dot, invert, solve};
use super::reading::Reading;
use super::screen::Screened;

/// An emitter on the sensor: centre in σ, energy in units of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Spot {
    pub u: [f64; 2],
    pub a: f64,
}

/// What is fitted beside the emitters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Nuisances {
    /// A constant and two slopes.
    pub background: bool,
    pub width: Width,
}

/// Whether the spot's width is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Width {
    #[default]
    Known,
    Common,
    PerAxis,
}

impl Nuisances {
    pub fn background_atoms(self) -> usize {
        if self.background { 3 } else { 0 }
    }

    fn widths(self) -> usize {
        match self.width {
            Width::Known => 0,
            Width::Common => 1,
            Width::PerAxis => 2,
        }
    }

    pub fn count(self) -> usize {
        self.background_atoms() + self.widths()
    }
}

/// A hypothesis about the frame.
#[derive(Clone, Debug)]
pub(super) struct Model {
    pub spots: Vec<Spot>,
    pub nuisances: Nuisances,
    pub background: [f64; 3],
    /// Relative to the configured σ.
    pub width: [f64; 2],
    /// Squared residual over the usable numbers, in units of the noise.
    pub deviance: f64,
    pub converged: bool,
}

impl Model {
    pub fn empty(nuisances: Nuisances) -> Self {
        Self {
            spots: Vec::new(),
            nuisances,
            background: [0.0; 3],
            width: [1.0; 2],
            deviance: f64::INFINITY,
            converged: false,
        }
    }

    pub fn parameters(&self) -> usize {
        3 * self.spots.len() + self.nuisances.count()
    }
}

const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-14;
const LAMBDA_CEILING: f64 = 1e10;
/// A fit has converged after two drops of the deviance below this.
const SMALL_DROP: f64 = 1e-3;
/// A fit has also converged where the next step promises less than this.
const NO_DROP: f64 = 1e-4;
/// Spots farther apart than this, σ, along either axis need no curved steps.
const OVERLAP: f64 = 3.0;
/// |acceleration|² over |velocity|² above which a step is not trusted (Transtrum and Sethna, 2012, eq. 15).
const LARGEST_ACCELERATION: f64 = 0.56 / 4.0;
/// Amplitudes stay above this many standard deviations of noise, so that a position keeps its gradient.
const AMPLITUDE_FLOOR: f64 = 0.05;

/// Atoms of all sources at one hypothesis.
#[derive(Default)]
struct Atoms {
    /// (sources, 3, mx): f, f′, f″.
    x: Vec<f64>,
    y: Vec<f64>,
    spots: Vec<Spot>,
    background: [f64; 3],
    width: [f64; 2],
}

/// The fit's scratch memory. Grows to the largest problem seen and then allocates nothing.
pub(super) struct Fitter {
    pub bx: Basis,
    pub by: Basis,
    background_x: [Vec<f64>; 2],
    background_y: [Vec<f64>; 2],
    now: Atoms,
    trial: Atoms,
    residual: Vec<f64>,
    trial_residual: Vec<f64>,
    dense: [Vec<f64>; 2],
    gram: [Vec<f64>; 6],
    hessian: Vec<f64>,
    factor: Vec<f64>,
    gradient: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    bend: Vec<f64>,
    scratch: Vec<f64>,
    strip: Vec<f64>,
    small: Vec<f64>,
    active: Vec<bool>,
    /// Work done since the last reset, multiplications.
    pub work: f64,
}

impl Fitter {
    pub fn new(bx: Basis, by: Basis) -> Self {
        let atoms = |b: &Basis| {
            let half = 0.5 * b.n as f64;
            let mut pair = [vec![0.0; b.stride], vec![0.0; b.stride]];
            // Of about a spot's norm, so that the normal equations are well scaled.
            b.compress((0..b.n).map(|_| 1.0 / (b.n as f64).sqrt()), &mut pair[0]);
            b.compress(
                (0..b.n).map(|k| (k as f64 + 0.5 - half) / half / (b.n as f64).sqrt()),
                &mut pair[1],
            );
            pair
        };
        let (background_x, background_y) = (atoms(&bx), atoms(&by));
        let scratch = vec![0.0; 3 * bx.n.max(by.n)];
        Self {
            background_x,
            background_y,
            bx,
            by,
            now: Atoms::default(),
            trial: Atoms::default(),
            residual: Vec::new(),
            trial_residual: Vec::new(),
            dense: Default::default(),
            gram: Default::default(),
            hessian: Vec::new(),
            factor: Vec::new(),
            gradient: Vec::new(),
            velocity: Vec::new(),
            acceleration: Vec::new(),
            bend: Vec::new(),
            scratch,
            strip: Vec::new(),
            small: Vec::new(),
            active: Vec::new(),
            work: 0.0,
        }
    }

    /// Fits `model` from where it stands, at most `steps` steps.
    pub fn fit(&mut self, reading: &Reading, model: &mut Model, steps: usize) {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            reading,
            model,
            steps,
        });
    }

    /// Residual of `model` in the bases, (my, mx), with the deviance set.
    pub fn residual_of(&mut self, reading: &Reading, model: &mut Model) -> &[f64] {
        self.fit(reading, model, 0);
        &self.residual
    }

    /// Turns the covariance of least squares under even noise into that under noise that grows with the signal,
    /// C JᵀVJ C (White, 1980, eq. 3).
    pub fn spread(&mut self, reading: &Reading, model: &Model, frame: &Screened, cov: &mut [f64]) {
        let p = model.parameters();
        let (n, widths) = (model.spots.len(), model.nuisances.widths());
        let sources = n + model.nuisances.background_atoms();
        let (mx, my) = (reading.mx, reading.my);
        let pixels = |b: &Basis, m: usize, atoms: &[f64]| -> Vec<f64> {
            (0..sources * 3)
                .flat_map(|i| (0..b.n).map(move |k| (i, k)))
                .map(|(i, k)| dot(&b.row(k)[..m], &atoms[i * m..(i + 1) * m]))
                .collect()
        };
        let (fx, fy) = (pixels(&self.bx, mx, &self.now.x), pixels(&self.by, my, &self.now.y));
        let (nx, ny) = (self.bx.n, self.by.n);
        let mut middle = vec![0.0; p * p];
        let mut row = vec![0.0; p];
        for y in 0..ny {
            for x in 0..nx {
                if frame.is_bad[y * nx + x] {
                    continue;
                }
                row.fill(0.0);
                let mut signal = 0.0;
                for i in 0..sources {
                    let [x0, x1, x2] = [0, 1, 2].map(|d| fx[(3 * i + d) * nx + x]);
                    let [y0, y1, y2] = [0, 1, 2].map(|d| fy[(3 * i + d) * ny + y]);
                    if i >= n {
                        row[2 * n + i] = x0 * y0;
                        signal += self.now.background[i - n] * x0 * y0;
                        continue;
                    }
                    let a = self.now.spots[i].a;
                    signal += a * x0 * y0;
                    (row[3 * i], row[3 * i + 1], row[3 * i + 2]) = (a * x1 * y0, a * x0 * y1, x0 * y0);
                    if widths > 0 {
                        row[p - widths] += a * self.now.width[0].powi(2) * x2 * y0;
                        row[p - 1] += a * self.now.width[1].powi(2) * x0 * y2;
                    }
                }
                let v = reading.growth.at(signal);
                for i in 0..p {
                    axpy(v * row[i], &row[..=i], &mut middle[i * p..i * p + i + 1]);
                }
            }
        }
        for i in 0..p {
            for j in 0..i {
                middle[j * p + i] = middle[i * p + j];
            }
        }
        let mut half = vec![0.0; p * p];
        for i in 0..p {
            for j in 0..p {
                half[i * p + j] = dot(&cov[i * p..(i + 1) * p], &middle[j * p..(j + 1) * p]);
            }
        }
        let full: Vec<f64> = (0..p * p)
            .map(|k| dot(&half[k / p * p..(k / p + 1) * p], &cov[k % p * p..(k % p + 1) * p]))
            .collect();
        cov.copy_from_slice(&full);
    }

    /// Inner products of the residual with each spot's second derivatives (xx, xy, yy): how it is bent there.
    pub fn curvatures(&mut self, reading: &Reading, model: &mut Model) -> Vec<[f64; 3]> {
        self.fit(reading, model, 0);
        let (mx, my) = (reading.mx, reading.my);
        let x = |i: usize, d: usize| &self.now.x[(3 * i + d) * mx..(3 * i + d + 1) * mx];
        let y = |i: usize, d: usize| &self.now.y[(3 * i + d) * my..(3 * i + d + 1) * my];
        let inner = |i: usize, a: usize, b: usize| {
            let rows = self.residual.chunks_exact(mx).zip(y(i, b));
            rows.map(|(row, w)| w * dot(row, x(i, a))).sum::<f64>()
        };
        (0..model.spots.len())
            .map(|i| [inner(i, 2, 0), inner(i, 1, 1), inner(i, 0, 2)])
            .collect()
    }

    /// Takes what unusable pixels hold out of a residual.
    pub fn clean(&self, reading: &Reading, nuisances: Nuisances, residual: &mut [f64]) {
        for bad in &reading.bad {
            let left = self.residual_at(reading, bad.x, bad.y, bad.value, &self.now, nuisances);
            let ux = &self.bx.row(bad.x)[..reading.mx];
            for (c, &u) in self.by.row(bad.y)[..reading.my].iter().enumerate() {
                axpy(-left * u, ux, &mut residual[c * reading.mx..(c + 1) * reading.mx]);
            }
        }
    }

    /// Information matrix at `model` over (x, y, energy) of each spot, then nuisances; units σ and noise. Row-major,
    /// lower triangle; see `Model::parameters`.
    pub fn information(&mut self, reading: &Reading, model: &mut Model) -> &[f64] {
        self.fit(reading, model, 0);
        self.linearise(reading, model.nuisances);
        &self.hessian
    }

    /// Inverse of an information matrix of `n` parameters with `prior` precision added to the spots' positions.
    pub fn covariance(&mut self, n: usize, spots: usize, prior: f64, out: &mut Vec<f64>) -> bool {
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..n * n]);
        for i in 0..spots {
            self.factor[3 * i * n + 3 * i] += prior;
            self.factor[(3 * i + 1) * n + 3 * i + 1] += prior;
        }
        for i in 0..n {
            self.factor[i * n + i] *= 1.0 + 1e-13;
        }
        if !cholesky(&mut self.factor, n) {
            return false;
        }
        out.clear();
        out.resize(n * n, 0.0);
        invert(&self.factor, n, out);
        true
    }

    #[inline(always)]
    fn run(&mut self, reading: &Reading, model: &mut Model, steps: usize) {
        let nuisances = model.nuisances;
        self.now.spots.clone_from(&model.spots);
        self.now.background = model.background;
        self.now.width = model.width;
        self.clamp_now();
        self.evaluate(reading, nuisances, false);
        self.solve_amplitudes(reading, nuisances, false);
        let mut deviance = self.subtract(reading, nuisances, false);
        let parameters = 3 * model.spots.len() + nuisances.count();
        let sources = (model.spots.len() + 1) as f64;
        let size = (reading.mx * reading.my) as f64;
        let work = sources * (9.0 * size + 40.0 * (reading.mx + reading.my) as f64) + 9.0 * sources.powi(3);
        let mut lambda = LAMBDA_START;
        let mut small_drops = 0;
        let mut converged = parameters == nuisances.background_atoms();
        let mut fresh = false;
        let overlap = self.now.spots.iter().enumerate().any(|(i, s)| {
            self.now.spots[..i]
                .iter()
                .any(|t| (s.u[0] - t.u[0]).abs() < OVERLAP && (s.u[1] - t.u[1]).abs() < OVERLAP)
        });
        for _ in 0..steps {
            if converged {
                break;
            }
            self.work += work;
            if !fresh {
                self.linearise(reading, nuisances);
                fresh = true;
            }
            let moved = self.step(reading, nuisances, lambda, overlap);
            if moved && lambda <= LAMBDA_START {
                let expected = dot(&self.velocity[..parameters], &self.gradient[..parameters]);
                if expected < NO_DROP {
                    converged = true;
                    break;
                }
            }
            let accepted = moved && {
                self.evaluate(reading, nuisances, true);
                self.solve_amplitudes(reading, nuisances, true);
                let next = self.subtract(reading, nuisances, true);
                let drop = deviance - next;
                if drop >= 0.0 {
                    small_drops = if drop < SMALL_DROP && lambda < 1e-3 {
                        small_drops + 1
                    } else {
                        0
                    };
                    deviance = next;
                }
                drop >= 0.0
            };
            if accepted {
                std::mem::swap(&mut self.now, &mut self.trial);
                std::mem::swap(&mut self.residual, &mut self.trial_residual);
                lambda = (lambda * 0.15).max(LAMBDA_FLOOR);
                fresh = false;
                converged = small_drops >= 2;
            } else {
                lambda *= 4.0;
                // Rounding, not curvature, is what refuses a step this short.
                if lambda > LAMBDA_CEILING {
                    converged = true;
                }
            }
        }
        model.spots.clone_from(&self.now.spots);
        model.background = self.now.background;
        model.width = self.now.width;
        model.deviance = deviance;
        // A fit of no steps only evaluates: it says nothing new about convergence.
        model.converged = converged || steps == 0 && model.converged;
    }

    #[inline(always)]
    fn clamp_now(&mut self) {
        for s in &mut self.now.spots {
            s.u[0] = s.u[0].clamp(self.bx.lowest(), self.bx.highest());
            s.u[1] = s.u[1].clamp(self.by.lowest(), self.by.highest());
        }
    }

    /// Fills the atoms of the present or the trial hypothesis.
    #[inline(always)]
    fn evaluate(&mut self, reading: &Reading, nuisances: Nuisances, is_trial: bool) {
        let atoms = if is_trial { &mut self.trial } else { &mut self.now };
        let (mx, my) = (reading.mx, reading.my);
        let n = atoms.spots.len();
        let sources = n + nuisances.background_atoms();
        atoms.x.resize(sources * 3 * mx, 0.0);
        atoms.y.resize(sources * 3 * my, 0.0);
        for (i, s) in atoms.spots.iter().enumerate() {
            let x = &mut atoms.x[i * 3 * mx..(i + 1) * 3 * mx];
            self.bx.atom(s.u[0], atoms.width[0], mx, &mut self.scratch, x);
            let y = &mut atoms.y[i * 3 * my..(i + 1) * 3 * my];
            self.by.atom(s.u[1], atoms.width[1], my, &mut self.scratch, y);
        }
        for b in 0..nuisances.background_atoms() {
            let x = &mut atoms.x[(n + b) * 3 * mx..(n + b + 1) * 3 * mx];
            x.fill(0.0);
            x[..mx].copy_from_slice(&self.background_x[usize::from(b == 1)][..mx]);
            let y = &mut atoms.y[(n + b) * 3 * my..(n + b + 1) * 3 * my];
            y.fill(0.0);
            y[..my].copy_from_slice(&self.background_y[usize::from(b == 2)][..my]);
        }
    }

    /// Least-squares amplitudes at the atoms' positions; those of spots are kept above a floor by an active set.
    #[inline(always)]
    fn solve_amplitudes(&mut self, reading: &Reading, nuisances: Nuisances, is_trial: bool) {
        let atoms = if is_trial { &mut self.trial } else { &mut self.now };
        let (mx, my) = (reading.mx, reading.my);
        let n = atoms.spots.len();
        let sources = n + nuisances.background_atoms();
        if sources == 0 {
            return;
        }
        self.small.resize(sources * sources, 0.0);
        self.strip.resize(self.strip.len().max(my.max(mx)), 0.0);
        let fx = |i: usize| &atoms.x[i * 3 * mx..i * 3 * mx + mx];
        let fy = |i: usize| &atoms.y[i * 3 * my..i * 3 * my + my];
        let gram = &mut self.small;
        let rhs = &mut self.acceleration;
        rhs.resize(sources.max(rhs.len()), 0.0);
        for i in 0..sources {
            for j in 0..=i {
                gram[i * sources + j] = dot(fx(i), fx(j)) * dot(fy(i), fy(j));
            }
            for c in 0..my {
                self.strip[c] = dot(&reading.z[c * mx..(c + 1) * mx], fx(i));
            }
            rhs[i] = dot(&self.strip[..my], fy(i));
        }
        for bad in &reading.bad {
            let (ux, uy) = (&self.bx.row(bad.x)[..mx], &self.by.row(bad.y)[..my]);
            let values = &mut self.scratch;
            values.resize(values.len().max(sources), 0.0);
            for i in 0..sources {
                values[i] = dot(ux, fx(i)) * dot(uy, fy(i));
                rhs[i] -= values[i] * bad.value;
            }
            for i in 0..sources {
                for j in 0..=i {
                    gram[i * sources + j] -= values[i] * values[j];
                }
            }
        }
        self.active.clear();
        self.active.resize(sources, true);
        let factor = &mut self.factor;
        let solution = &mut self.bend;
        solution.resize(sources.max(solution.len()), 0.0);
        let floor = |i: usize| AMPLITUDE_FLOOR / gram[i * sources + i].max(1e-30).sqrt();
        loop {
            let mut order = 0;
            factor.resize(factor.len().max(sources * sources), 0.0);
            let size = self.active.iter().filter(|a| **a).count();
            for i in (0..sources).filter(|&i| self.active[i]) {
                let mut b = rhs[i];
                for k in (0..sources).filter(|&k| !self.active[k]) {
                    b -= gram[i.max(k) * sources + i.min(k)] * floor(k);
                }
                solution[order] = b;
                for (column, j) in (0..=i).filter(|&j| self.active[j]).enumerate() {
                    factor[order * size + column] = gram[i * sources + j];
                }
                factor[order * size + order] *= 1.0 + 1e-13;
                order += 1;
            }
            if size > 0 {
                let mut ridge = 1e-12;
                while !cholesky(&mut factor[..size * size], size) {
                    let mut row = 0;
                    for i in (0..sources).filter(|&i| self.active[i]) {
                        for (column, j) in (0..=i).filter(|&j| self.active[j]).enumerate() {
                            factor[row * size + column] = gram[i * sources + j];
                        }
                        factor[row * size + row] = gram[i * sources + i].max(1e-30) * (1.0 + ridge);
                        row += 1;
                    }
                    ridge *= 10.0;
                }
                solve(factor, size, solution);
            }
            let mut row = 0;
            let mut clipped = false;
            for i in 0..sources {
                if !self.active[i] {
                    if i < n {
                        atoms.spots[i].a = floor(i);
                    }
                    continue;
                }
                let a = solution[row];
                row += 1;
                if i >= n {
                    atoms.background[i - n] = a;
                } else if a < floor(i) {
                    self.active[i] = false;
                    clipped = true;
                } else {
                    atoms.spots[i].a = a;
                }
            }
            if !clipped {
                break;
            }
        }
    }

    /// Residual and deviance of the present or the trial hypothesis.
    #[inline(always)]
    fn subtract(&mut self, reading: &Reading, nuisances: Nuisances, is_trial: bool) -> f64 {
        let (atoms, residual) = if is_trial {
            (&self.trial, &mut self.trial_residual)
        } else {
            (&self.now, &mut self.residual)
        };
        let (mx, my) = (reading.mx, reading.my);
        let n = atoms.spots.len();
        residual.clear();
        residual.extend_from_slice(&reading.z);
        for i in 0..n + nuisances.background_atoms() {
            let a = if i < n {
                atoms.spots[i].a
            } else {
                atoms.background[i - n]
            };
            let fx = &atoms.x[i * 3 * mx..i * 3 * mx + mx];
            let fy = &atoms.y[i * 3 * my..i * 3 * my + my];
            for c in 0..my {
                axpy(-a * fy[c], fx, &mut residual[c * mx..(c + 1) * mx]);
            }
        }
        let mut deviance = dot(residual, residual);
        for bad in &reading.bad {
            deviance -= self
                .residual_at(reading, bad.x, bad.y, bad.value, atoms, nuisances)
                .powi(2);
        }
        deviance
    }

    /// What a pixel holds beyond the model.
    #[inline(always)]
    fn residual_at(
        &self,
        reading: &Reading,
        x: usize,
        y: usize,
        value: f64,
        atoms: &Atoms,
        nuisances: Nuisances,
    ) -> f64 {
        let (mx, my) = (reading.mx, reading.my);
        let (ux, uy) = (&self.bx.row(x)[..mx], &self.by.row(y)[..my]);
        let n = atoms.spots.len();
        let mut left = value;
        for i in 0..n + nuisances.background_atoms() {
            let a = if i < n {
                atoms.spots[i].a
            } else {
                atoms.background[i - n]
            };
            let fx = &atoms.x[i * 3 * mx..i * 3 * mx + mx];
            let fy = &atoms.y[i * 3 * my..i * 3 * my + my];
            left -= a * dot(ux, fx) * dot(uy, fy);
        }
        left
    }

    /// Gradient Jᵀr and information JᵀJ at the present hypothesis.
    #[inline(always)]
    fn linearise(&mut self, reading: &Reading, nuisances: Nuisances) {
        let (mx, my) = (reading.mx, reading.my);
        let n = self.now.spots.len();
        let sources = n + nuisances.background_atoms();
        let p = 3 * n + nuisances.count();
        let (atoms, gram) = (&self.now, &mut self.gram);
        let (sx, sy) = (3 * mx, 3 * my);
        let x = |i: usize, d: usize| &atoms.x[i * sx + d * mx..i * sx + (d + 1) * mx];
        let y = |i: usize, d: usize| &atoms.y[i * sy + d * my..i * sy + (d + 1) * my];
        for g in gram.iter_mut() {
            g.resize(sources * sources, 0.0);
        }
        for i in 0..sources {
            for j in 0..sources {
                let k = i * sources + j;
                if j <= i {
                    gram[0][k] = dot(x(i, 0), x(j, 0));
                    gram[3][k] = dot(y(i, 0), y(j, 0));
                    gram[2][k] = dot(x(i, 1), x(j, 1));
                    gram[5][k] = dot(y(i, 1), y(j, 1));
                }
                gram[1][k] = dot(x(i, 1), x(j, 0));
                gram[4][k] = dot(y(i, 1), y(j, 0));
            }
        }
        let h = &mut self.hessian;
        h.resize(p * p, 0.0);
        let amplitude = |i: usize| if i < n { atoms.spots[i].a } else { 0.0 };
        for i in 0..sources {
            let ai = amplitude(i);
            for j in 0..=i {
                let aj = amplitude(j);
                let (k, t) = (i * sources + j, j * sources + i);
                let [x00, x10, x11, y00, y10, y11] = [0, 1, 2, 3, 4, 5].map(|g| gram[g][k]);
                let (x01, y01) = (gram[1][t], gram[4][t]);
                if j < n && i < n {
                    let block = [
                        ai * aj * x11 * y00,
                        ai * aj * x10 * y01,
                        ai * x10 * y00,
                        ai * aj * x01 * y10,
                        ai * aj * x00 * y11,
                        ai * x00 * y10,
                        aj * x01 * y00,
                        aj * x00 * y01,
                        x00 * y00,
                    ];
                    for r in 0..3 {
                        h[(3 * i + r) * p + 3 * j..(3 * i + r) * p + 3 * j + 3]
                            .copy_from_slice(&block[3 * r..3 * r + 3]);
                    }
                } else if j < n {
                    let row = &mut h[(2 * n + i) * p + 3 * j..(2 * n + i) * p + 3 * j + 3];
                    row.copy_from_slice(&[aj * x01 * y00, aj * x00 * y01, x00 * y00]);
                } else {
                    h[(2 * n + i) * p + 2 * n + j] = x00 * y00;
                }
            }
        }
        let widths = nuisances.widths();
        let first_width = p - widths;
        for d in &mut self.dense[..widths] {
            d.clear();
            d.resize(mx * my, 0.0);
        }
        // ∂/∂ln w of a spot is w² f″ (the heat equation).
        for i in 0..if widths > 0 { n } else { 0 } {
            let (ax, ay) = (
                atoms.spots[i].a * atoms.width[0].powi(2),
                atoms.spots[i].a * atoms.width[1].powi(2),
            );
            for c in 0..my {
                axpy(ax * y(i, 0)[c], x(i, 2), &mut self.dense[0][c * mx..(c + 1) * mx]);
                axpy(
                    ay * y(i, 2)[c],
                    x(i, 0),
                    &mut self.dense[widths - 1][c * mx..(c + 1) * mx],
                );
            }
        }
        let g = &mut self.gradient;
        g.resize(p.max(g.len()), 0.0);
        self.strip.resize(2 * my.max(mx), 0.0);
        for i in 0..sources {
            let s = project(
                &self.residual,
                mx,
                my,
                x(i, 0),
                x(i, 1),
                y(i, 0),
                y(i, 1),
                &mut self.strip,
            );
            if i < n {
                let a = amplitude(i);
                (g[3 * i], g[3 * i + 1], g[3 * i + 2]) = (a * s[1], a * s[2], s[0]);
            } else {
                g[2 * n + i] = s[0];
            }
            for w in 0..widths {
                let s = project(
                    &self.dense[w],
                    mx,
                    my,
                    x(i, 0),
                    x(i, 1),
                    y(i, 0),
                    y(i, 1),
                    &mut self.strip,
                );
                let row = &mut h[(first_width + w) * p..(first_width + w + 1) * p];
                if i < n {
                    let a = amplitude(i);
                    (row[3 * i], row[3 * i + 1], row[3 * i + 2]) = (a * s[1], a * s[2], s[0]);
                } else {
                    row[2 * n + i] = s[0];
                }
            }
        }
        for w in 0..widths {
            g[first_width + w] = dot(&self.dense[w], &self.residual);
            for v in 0..=w {
                h[(first_width + w) * p + first_width + v] = dot(&self.dense[w], &self.dense[v]);
            }
        }
        for bad in &reading.bad {
            let (ux, uy) = (&self.bx.row(bad.x)[..mx], &self.by.row(bad.y)[..my]);
            let row = &mut self.velocity;
            row.resize(p.max(row.len()), 0.0);
            row[first_width..p].fill(0.0);
            let mut left = bad.value;
            for i in 0..sources {
                let (x0, y0) = (dot(ux, x(i, 0)), dot(uy, y(i, 0)));
                if i >= n {
                    row[2 * n + i] = x0 * y0;
                    left -= atoms.background[i - n] * x0 * y0;
                    continue;
                }
                let a = amplitude(i);
                left -= a * x0 * y0;
                let (x1, y1) = (dot(ux, x(i, 1)), dot(uy, y(i, 1)));
                (row[3 * i], row[3 * i + 1], row[3 * i + 2]) = (a * x1 * y0, a * x0 * y1, x0 * y0);
                if widths > 0 {
                    row[first_width] += a * atoms.width[0].powi(2) * dot(ux, x(i, 2)) * y0;
                    row[p - 1] += a * atoms.width[1].powi(2) * x0 * dot(uy, y(i, 2));
                }
            }
            for i in 0..p {
                g[i] -= row[i] * left;
                let s = -row[i];
                axpy(s, &row[..i + 1], &mut h[i * p..i * p + i + 1]);
            }
        }
    }

    /// Sets the trial hypothesis one damped, accelerated step away. `false` where no step could be had.
    #[inline(always)]
    fn step(&mut self, reading: &Reading, nuisances: Nuisances, lambda: f64, overlap: bool) -> bool {
        let n = self.now.spots.len();
        let p = 3 * n + nuisances.count();
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..p * p]);
        for i in 0..p {
            self.factor[i * p + i] = self.factor[i * p + i].max(1e-30) * (1.0 + lambda + 1e-14);
        }
        if !cholesky(&mut self.factor, p) {
            return false;
        }
        self.velocity.clear();
        self.velocity.extend_from_slice(&self.gradient[..p]);
        solve(&self.factor, p, &mut self.velocity);
        if overlap {
            self.accelerate(reading, nuisances, p);
        } else {
            self.acceleration.clear();
            self.acceleration.resize(p, 0.0);
        }
        let (mut speed, mut turn) = (0.0, 0.0);
        for i in 0..p {
            let scale = self.hessian[i * p + i];
            speed += scale * self.velocity[i].powi(2);
            turn += scale * self.acceleration[i].powi(2);
        }
        let is_trusted = turn <= LARGEST_ACCELERATION * speed;
        let delta = |i: usize| {
            let d = self.velocity[i] + if is_trusted { 0.5 * self.acceleration[i] } else { 0.0 };
            d.clamp(-1.0, 1.0)
        };
        let trial = &mut self.trial;
        trial.spots.clone_from(&self.now.spots);
        for (i, s) in trial.spots.iter_mut().enumerate() {
            s.u[0] = (s.u[0] + delta(3 * i)).clamp(self.bx.lowest(), self.bx.highest());
            s.u[1] = (s.u[1] + delta(3 * i + 1)).clamp(self.by.lowest(), self.by.highest());
        }
        trial.background = self.now.background;
        trial.width = self.now.width;
        let widths = nuisances.widths();
        for w in 0..if widths > 0 { 2 } else { 0 } {
            let d = delta(p - widths + w.min(widths - 1)).clamp(-0.1, 0.1);
            trial.width[w] = (self.now.width[w] * d.exp()).clamp(0.5, 2.0);
        }
        true
    }

    /// Geodesic acceleration a = −(JᵀJ + λD)⁻¹ Jᵀ M_vv, with M_vv the model's second derivative along the velocity.
    #[inline(always)]
    fn accelerate(&mut self, reading: &Reading, nuisances: Nuisances, p: usize) {
        let (mx, my) = (reading.mx, reading.my);
        let atoms = &self.now;
        let n = atoms.spots.len();
        let (sx, sy) = (3 * mx, 3 * my);
        let x = |i: usize, d: usize| &atoms.x[i * sx + d * mx..i * sx + (d + 1) * mx];
        let y = |i: usize, d: usize| &atoms.y[i * sy + d * my..i * sy + (d + 1) * my];
        let bend = &mut self.bend;
        bend.clear();
        bend.resize(mx * my, 0.0);
        self.strip.resize((3 * mx).max(2 * my.max(mx)), 0.0);
        for i in 0..n {
            let a = atoms.spots[i].a;
            let (vx, vy, va) = (self.velocity[3 * i], self.velocity[3 * i + 1], self.velocity[3 * i + 2]);
            let strip = &mut self.strip[..3 * mx];
            let (q0, rest) = strip.split_at_mut(mx);
            let (q1, q2) = rest.split_at_mut(mx);
            let (f, f1, f2) = (x(i, 0), x(i, 1), x(i, 2));
            for c in 0..mx {
                q0[c] = a * vx * vx * f2[c] + 2.0 * va * vx * f1[c];
                q1[c] = 2.0 * a * vx * vy * f1[c] + 2.0 * va * vy * f[c];
                q2[c] = a * vy * vy * f[c];
            }
            let (g0, g1, g2) = (y(i, 0), y(i, 1), y(i, 2));
            for c in 0..my {
                let row = &mut bend[c * mx..(c + 1) * mx];
                for k in 0..mx {
                    row[k] += g0[c] * q0[k] + g1[c] * q1[k] + g2[c] * q2[k];
                }
            }
        }
        self.acceleration.clear();
        self.acceleration.resize(p, 0.0);
        let out = &mut self.acceleration;
        for i in 0..n + nuisances.background_atoms() {
            let s = project(bend, mx, my, x(i, 0), x(i, 1), y(i, 0), y(i, 1), &mut self.strip);
            if i < n {
                let a = atoms.spots[i].a;
                (out[3 * i], out[3 * i + 1], out[3 * i + 2]) = (-a * s[1], -a * s[2], -s[0]);
            } else {
                out[2 * n + i] = -s[0];
            }
        }
        let widths = nuisances.widths();
        for w in 0..widths {
            out[p - widths + w] = -dot(&self.dense[w], bend);
        }
        solve(&self.factor, p, out);
    }
}

/// Inner products of a matrix with f_y⊗f_x, f_y⊗f′_x and f′_y⊗f_x.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inlined kernel on the caller's slices")]
fn project(
    matrix: &[f64],
    mx: usize,
    my: usize,
    x0: &[f64],
    x1: &[f64],
    y0: &[f64],
    y1: &[f64],
    strip: &mut [f64],
) -> [f64; 3] {
    let (t0, t1) = strip.split_at_mut(my);
    for c in 0..my {
        let row = &matrix[c * mx..(c + 1) * mx];
        t0[c] = dot(row, x0);
        t1[c] = dot(row, x1);
    }
    [dot(t0, y0), dot(&t1[..my], y0), dot(t0, y1)]
}

struct Job<'a> {
    fitter: &'a mut Fitter,
    reading: &'a Reading,
    model: &'a mut Model,
    steps: usize,
}

impl pulp::NullaryFnOnce for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.fitter.run(self.reading, self.model, self.steps);
    }
}
