//! The joint fit of all emitters and nuisances to one reading: Levenberg–Marquardt in separable form.
//!
//! A frame is F_y·diag(A)·F_xᵀ, so a residual costs O(m² N) and the normal equations are Hadamard products of small
//! Gram matrices, O(m N²) (Golub and Pereyra, 1973, for separable least squares). Steps carry geodesic acceleration
//! (Transtrum and Sethna, 2012, eq. 14), amplitudes are solved anew at each trial, and unusable pixels are taken out of
//! the normal equations one by one, which is exact whatever they were filled with.
//!
//! In the pixel bases every source is touched only where it holds light, and pixels may have weights of their own.

use std::time::Instant;

use super::atoms::{self, Atoms};
use super::basis::Basis;
use super::linear::{axpy, cholesky, dot, solve};
use super::model::{Model, Nuisances, pull};
use super::reading::Reading;
use super::unusable::BadPixel;

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
/// A bar is out of reach when this many times the drop that a quadratic promises does not get there.
const HOPE: f64 = 5.0;
/// Multiplications that a frame of a few emitters may cost: the same for every run, unlike a clock.
const MOST_WORK: f64 = 1e8;
/// Emitters from which on a frame may cost more, with the square of their number, and up to how many times as many.
const MANY: f64 = 8.0;
const MOST_TIMES: f64 = 5.0;
/// Share that the last fit may take beyond.
const BEYOND: f64 = 1.2;

/// The fit's scratch memory. Grows to the largest problem seen and then allocates nothing.
pub(super) struct Fitter {
    pub bx: Basis,
    pub by: Basis,
    backgrounds: [[Vec<f64>; 2]; 2],
    pub(super) now: Atoms,
    pub(super) trial: Atoms,
    /// Weighted residual, (my, mx).
    pub(super) residual: Vec<f64>,
    trial_residual: Vec<f64>,
    /// The frame's derivatives in the widths, (my, mx), plain and weighted.
    pub(super) broadening: [Vec<f64>; 2],
    pub(super) weighted: Vec<f64>,
    pub(super) hessian: Vec<f64>,
    pub(super) factor: Vec<f64>,
    pub(super) gradient: Vec<f64>,
    velocity: Vec<f64>,
    pub(super) acceleration: Vec<f64>,
    pub(super) bend: Vec<f64>,
    pub(super) scratch: Vec<f64>,
    pub(super) strip: Vec<f64>,
    pub(super) small: Vec<f64>,
    pub(super) active: Vec<bool>,
    /// Multiplications since the last frame, and the time it must be done by.
    work: f64,
    /// Sources of the largest hypothesis since.
    most_sources: f64,
    /// Steps since.
    pub steps: u64,
    deadline: Option<Instant>,
}

impl Fitter {
    pub fn new(bx: Basis, by: Basis) -> Self {
        let scratch = vec![0.0; 3 * bx.n.max(by.n)];
        Self {
            backgrounds: [atoms::background(&bx), atoms::background(&by)],
            bx,
            by,
            now: Atoms::default(),
            trial: Atoms::default(),
            residual: Vec::new(),
            trial_residual: Vec::new(),
            broadening: Default::default(),
            weighted: Vec::new(),
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
            most_sources: 0.0,
            steps: 0,
            deadline: None,
        }
    }

    /// Forgets the work done for the last frame.
    pub fn restart(&mut self, deadline: Option<Instant>) {
        self.work = 0.0;
        self.most_sources = 0.0;
        self.steps = 0;
        self.deadline = deadline;
    }

    /// Leaves at least this share of a frame's work for what comes.
    pub fn reserve(&mut self, share: f64) {
        self.work = self.work.min((1.0 - share) * self.most_work());
    }

    fn most_work(&self) -> f64 {
        MOST_WORK * (self.most_sources / MANY).clamp(1.0, MOST_TIMES).powi(2)
    }

    /// Whether the frame has had its share of work, or of time where a budget is set.
    pub fn is_exhausted(&self) -> bool {
        self.work > self.most_work() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Fits `model` from where it stands, at most `steps` steps.
    pub fn fit(&mut self, reading: &Reading, model: &mut Model, steps: usize) {
        self.fit_below(reading, model, steps, f64::INFINITY);
    }

    /// The same, given up as soon as a deviance below `bar` is out of reach.
    pub fn fit_below(&mut self, reading: &Reading, model: &mut Model, steps: usize, bar: f64) {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            reading,
            model,
            steps,
            bar,
            wants_information: false,
        });
    }

    /// Sets the information matrix at `model` over (x, y, energy) of each spot, then nuisances; units σ and noise. Row-major,
    /// upper triangle; see `Model::parameters`.
    pub fn information(&mut self, reading: &Reading, model: &mut Model) {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            reading,
            model,
            steps: 0,
            bar: f64::INFINITY,
            wants_information: true,
        });
    }

    /// Weighted residual of `model` in the bases, (my, mx), with the deviance set.
    pub fn residual_of(&mut self, reading: &Reading, model: &mut Model) -> &[f64] {
        self.fit(reading, model, 0);
        &self.residual
    }

    /// What `model` expects of the frame, (my, mx).
    pub fn expectation(&mut self, reading: &Reading, model: &mut Model) -> Vec<f64> {
        self.fit(reading, model, 0);
        let mut sum = vec![0.0; reading.mx * reading.my];
        for i in 0..self.now.sources() {
            self.now.add(i, 0, 0, self.now.amplitude(i), &mut sum);
        }
        sum
    }

    /// Takes what unusable pixels hold out of a residual.
    pub fn clean(&self, reading: &Reading, residual: &mut [f64]) {
        for bad in &reading.bad {
            let left = residual_at(bad, &self.now);
            let ux = &self.bx.row(bad.x)[..reading.mx];
            let uy = self.by.row(bad.y)[..reading.my].iter().enumerate();
            for (c, &u) in uy.filter(|(_, u)| **u != 0.0) {
                axpy(-left * u, ux, &mut residual[c * reading.mx..(c + 1) * reading.mx]);
            }
        }
    }

    #[inline(always)]
    fn run(&mut self, reading: &Reading, model: &mut Model, steps: usize, bar: f64) {
        let nuisances = model.nuisances;
        self.now.spots.clone_from(&model.spots);
        self.now.background = model.background;
        self.now.width = model.width;
        for s in &mut self.now.spots {
            s.u[0] = s.u[0].clamp(self.bx.lowest(), self.bx.highest());
            s.u[1] = s.u[1].clamp(self.by.lowest(), self.by.highest());
        }
        let mut deviance = self.evaluate(reading, nuisances, false);
        let parameters = model.parameters();
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
            if converged || self.work > BEYOND * self.most_work() {
                break;
            }
            self.most_sources = self.most_sources.max(self.now.sources() as f64);
            self.work += self.step_work(reading);
            self.steps += 1;
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
                if deviance - HOPE * expected > bar {
                    break;
                }
            }
            let accepted = moved && {
                let next = self.evaluate(reading, nuisances, true);
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
        model.deviance = deviance - pull(&model.spots);
        // A fit of no steps only evaluates: it says nothing new about convergence.
        model.converged = converged || steps == 0 && model.converged;
    }

    /// Multiplications that one step costs.
    fn step_work(&self, reading: &Reading) -> f64 {
        let sources = self.now.sources() as f64;
        let parameters = 3.0 * sources;
        let unusable = reading.bad.len() as f64 * (2.0 * parameters + 0.5 * parameters * parameters);
        let pairs = if reading.weights.is_empty() { 0.0 } else { 3.0 * sources };
        unusable
            + (9.0 + pairs) * self.now.footprint()
            + 40.0 * sources * (reading.mx + reading.my) as f64
            + 9.0 * sources.powi(3)
    }

    /// Places the atoms of the present or the trial hypothesis, solves their amplitudes, and returns the deviance.
    #[inline(always)]
    fn evaluate(&mut self, reading: &Reading, nuisances: Nuisances, is_trial: bool) -> f64 {
        let atoms = if is_trial { &mut self.trial } else { &mut self.now };
        let backgrounds = [&self.backgrounds[0], &self.backgrounds[1]];
        atoms.place([&self.bx, &self.by], backgrounds, reading, nuisances, &mut self.scratch);
        self.solve_amplitudes(reading, is_trial);
        let spots = if is_trial { &self.trial.spots } else { &self.now.spots };
        pull(spots) + self.subtract(reading, is_trial)
    }

    /// Weighted residual and deviance of the present or the trial hypothesis.
    #[inline(always)]
    fn subtract(&mut self, reading: &Reading, is_trial: bool) -> f64 {
        let (atoms, residual) = if is_trial {
            (&self.trial, &mut self.trial_residual)
        } else {
            (&self.now, &mut self.residual)
        };
        residual.clear();
        residual.extend_from_slice(&reading.z);
        for i in 0..atoms.sources() {
            atoms.add(i, 0, 0, -atoms.amplitude(i), residual);
        }
        if !reading.weights.is_empty() {
            let mut deviance = 0.0;
            for (r, w) in residual.iter_mut().zip(&reading.weights) {
                let weighted = w * *r;
                deviance += weighted * *r;
                *r = weighted;
            }
            return deviance;
        }
        let mut deviance = dot(residual, residual);
        for bad in &reading.bad {
            deviance -= residual_at(bad, atoms).powi(2);
        }
        deviance
    }

    /// Gradient Jᵀr and information JᵀJ at the present hypothesis.
    #[inline(always)]
    fn linearise(&mut self, reading: &Reading, nuisances: Nuisances) {
        let (mx, my) = (reading.mx, reading.my);
        let n = self.now.spots.len();
        let p = 3 * n + nuisances.count();
        let atoms = &self.now;
        let sources = atoms.sources();
        let h = &mut self.hessian;
        h.resize(p * p, 0.0);
        let g = &mut self.gradient;
        g.resize(p.max(g.len()), 0.0);
        for i in 0..sources {
            let ai = atoms.amplitude(i);
            for j in i..sources {
                let aj = atoms.amplitude(j);
                let c = atoms.couple(i, j, &reading.weights, &mut self.strip);
                if j < n {
                    let block = [
                        ai * aj * c[0],
                        ai * aj * c[1],
                        ai * c[2],
                        ai * aj * c[3],
                        ai * aj * c[4],
                        ai * c[5],
                        aj * c[6],
                        aj * c[7],
                        c[8],
                    ];
                    for r in 0..3 {
                        h[(3 * i + r) * p + 3 * j..(3 * i + r) * p + 3 * j + 3]
                            .copy_from_slice(&block[3 * r..3 * r + 3]);
                    }
                } else if i < n {
                    for (r, v) in [ai * c[2], ai * c[5], c[8]].into_iter().enumerate() {
                        h[(3 * i + r) * p + 2 * n + j] = v;
                    }
                } else {
                    h[(2 * n + i) * p + 2 * n + j] = c[8];
                }
            }
            let s = atoms.project(i, &self.residual, &mut self.strip);
            if i < n {
                (g[3 * i], g[3 * i + 1], g[3 * i + 2]) = (ai * s[1], ai * s[2], s[0]);
                if let Some(power) = atoms.spots[i].power {
                    h[(3 * i + 2) * p + 3 * i + 2] += power.precision;
                    g[3 * i + 2] += power.precision * (power.mean - ai);
                }
            } else {
                g[2 * n + i] = s[0];
            }
        }
        let widths = nuisances.widths();
        let first_width = p - widths;
        for d in &mut self.broadening[..widths] {
            d.clear();
            d.resize(mx * my, 0.0);
        }
        // ∂/∂ln w of a spot is w² f″ (the heat equation).
        for i in 0..if widths > 0 { n } else { 0 } {
            let [ax, ay] = atoms.width.map(|w| atoms.spots[i].a * w * w);
            atoms.add(i, 2, 0, ax, &mut self.broadening[0]);
            atoms.add(i, 0, 2, ay, &mut self.broadening[widths - 1]);
        }
        for w in 0..widths {
            let weighted = &mut self.weighted;
            weighted.clone_from(&self.broadening[w]);
            for (d, w) in weighted.iter_mut().zip(&reading.weights) {
                *d *= w;
            }
            let column = first_width + w;
            for i in 0..sources {
                let s = atoms.project(i, weighted, &mut self.strip);
                if i < n {
                    let a = atoms.spots[i].a;
                    for (r, v) in [a * s[1], a * s[2], s[0]].into_iter().enumerate() {
                        h[(3 * i + r) * p + column] = v;
                    }
                } else {
                    h[(2 * n + i) * p + column] = s[0];
                }
            }
            for v in 0..=w {
                h[(first_width + v) * p + column] = dot(weighted, &self.broadening[v]);
            }
            g[first_width + w] = dot(&self.broadening[w], &self.residual);
        }
        for bad in &reading.bad {
            let row = &mut self.velocity;
            row.resize(p.max(row.len()), 0.0);
            let left = slope_at(bad, atoms, widths, &mut row[..p]);
            for i in (0..p).filter(|&i| row[i] != 0.0) {
                g[i] -= row[i] * left;
                let s = -row[i];
                axpy(s, &row[i..p], &mut h[i * p + i..(i + 1) * p]);
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
        let atoms = &self.now;
        let n = atoms.spots.len();
        let bend = &mut self.bend;
        bend.clear();
        bend.resize(reading.mx * reading.my, 0.0);
        for i in 0..n {
            let a = atoms.spots[i].a;
            let (vx, vy, va) = (self.velocity[3 * i], self.velocity[3 * i + 1], self.velocity[3 * i + 2]);
            atoms.add_bent(
                i,
                [a * vx * vx, 2.0 * va * vx],
                [2.0 * a * vx * vy, 2.0 * va * vy],
                a * vy * vy,
                &mut self.scratch,
                bend,
            );
        }
        for (b, w) in bend.iter_mut().zip(&reading.weights) {
            *b *= w;
        }
        self.acceleration.clear();
        self.acceleration.resize(p, 0.0);
        let out = &mut self.acceleration;
        for i in 0..atoms.sources() {
            let s = atoms.project(i, bend, &mut self.strip);
            if i < n {
                let a = atoms.spots[i].a;
                (out[3 * i], out[3 * i + 1], out[3 * i + 2]) = (-a * s[1], -a * s[2], -s[0]);
            } else {
                out[2 * n + i] = -s[0];
            }
        }
        let widths = nuisances.widths();
        for w in 0..widths {
            out[p - widths + w] = -dot(&self.broadening[w], bend);
        }
        solve(&self.factor, p, out);
    }
}

/// What an unusable pixel holds beyond the model, and the model's slope there in all parameters.
#[inline(always)]
pub(super) fn slope_at(bad: &BadPixel, atoms: &Atoms, widths: usize, row: &mut [f64]) -> f64 {
    let (n, p) = (atoms.spots.len(), row.len());
    row[p - widths..].fill(0.0);
    let mut left = bad.value;
    for i in 0..atoms.sources() {
        let [[x0, x1, x2], [y0, y1, y2]] = atoms.at(i, bad.x, bad.y);
        let a = atoms.amplitude(i);
        left -= a * x0 * y0;
        if i >= n {
            row[2 * n + i] = x0 * y0;
            continue;
        }
        (row[3 * i], row[3 * i + 1], row[3 * i + 2]) = (a * x1 * y0, a * x0 * y1, x0 * y0);
        if widths > 0 {
            row[p - widths] += a * atoms.width[0].powi(2) * x2 * y0;
            row[p - 1] += a * atoms.width[1].powi(2) * x0 * y2;
        }
    }
    left
}

/// What an unusable pixel holds beyond the model.
#[inline(always)]
fn residual_at(bad: &BadPixel, atoms: &Atoms) -> f64 {
    let mut left = bad.value;
    for i in 0..atoms.sources() {
        let [x, y] = atoms.at(i, bad.x, bad.y);
        left -= atoms.amplitude(i) * x[0] * y[0];
    }
    left
}

struct Job<'a> {
    fitter: &'a mut Fitter,
    reading: &'a Reading,
    model: &'a mut Model,
    steps: usize,
    bar: f64,
    wants_information: bool,
}

impl pulp::NullaryFnOnce for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.fitter.run(self.reading, self.model, self.steps, self.bar);
        if self.wants_information {
            self.fitter.linearise(self.reading, self.model.nuisances);
        }
    }
}
