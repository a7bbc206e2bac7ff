//! The joint fit of all emitters and nuisances to one reading: Levenberg–Marquardt in separable form.
//!
//! A frame is F_y·diag(A)·F_xᵀ, so a residual costs O(m² N) and the normal equations are Hadamard products of small
//! Gram matrices, O(m N²) (Golub and Pereyra, 1973, for separable least squares). Steps carry geodesic acceleration
//! (Transtrum and Sethna, 2012, eq. 14), amplitudes are solved anew at each trial, and unusable pixels are taken out of
//! the normal equations again, which is exact whatever they were filled with.
//!
//! In the pixel bases every source is touched only where it holds light, and pixels may have weights of their own.

use std::time::Instant;

use crate::estimate::dense_linalg::dot;
use crate::estimate::fit::source_groups;
use crate::estimate::fit::work_budget::BEYOND;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, pull};
use crate::estimate::model::separable_model::{self, Atoms};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::uncertainty::posterior_mean::Tether;

const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-14;
const LAMBDA_CEILING: f64 = 1e10;
/// A fit has converged after two drops of the deviance below this.
const SMALL_DROP: f64 = 1e-3;
/// A fit has also converged where the next step promises less than this.
const NO_DROP: f64 = 1e-4;
/// Spots farther apart than this, σ, along either axis need no curved steps.
const OVERLAP: f64 = 3.0;
/// A bar is out of reach when this many times the drop that a quadratic promises does not get there.
const HOPE: f64 = 5.0;
/// A deviance of this many times its expectation says that emitters are missing; the last digits of the others matter little then.
const FAR_OFF: f64 = 100.0;
/// So far off, a fit ends after so many steps in a row that each bring less than this share of the deviance.
const IDLE: f64 = 1e-2;
const IDLE_STEPS: usize = 3;
/// A fit goes on past its steps, up to so many times as many, while the last one taken brought more than this share.
const BRISK: f64 = 0.2;
pub(crate) const MOST_STEPS: usize = 8;
/// Steps of all emitters together before those that still move are fitted alone, and how often.
pub(crate) const TOGETHER: usize = 2;
const PARTINGS: usize = 2;
/// The fit's scratch memory. Grows to the largest problem seen and then allocates nothing.
pub(crate) struct Fitter {
    pub bx: Basis,
    pub by: Basis,
    pub(crate) backgrounds: [[Vec<f64>; 2]; 2],
    pub(crate) now: Atoms,
    pub(crate) trial: Atoms,
    /// Weighted residual, (my, mx).
    pub(crate) residual: Vec<f64>,
    trial_residual: Vec<f64>,
    /// The frame's derivatives in the widths and the turn, (my, mx), plain and weighted.
    pub(crate) broadening: [Vec<f64>; 3],
    pub(crate) weighted: Vec<f64>,
    /// Where the spots are held together on a line through their places, if they are.
    pub tether: Option<Tether>,
    pub(crate) hessian: Vec<f64>,
    pub(crate) factor: Vec<f64>,
    pub(crate) gradient: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) acceleration: Vec<f64>,
    pub(crate) bend: Vec<f64>,
    pub(crate) scratch: Vec<f64>,
    pub(crate) strip: Vec<f64>,
    pub(crate) small: Vec<f64>,
    pub(crate) active: Vec<bool>,
    /// Multiplications since the last frame, and the time it must be done by.
    pub(crate) work: f64,
    /// Work that must not be exceeded, whatever the hypotheses.
    pub(crate) limit: f64,
    /// Sources of the largest hypothesis since.
    pub(crate) most_sources: f64,
    /// Steps since.
    pub steps: u64,
    pub(crate) deadline: Option<Instant>,
}

impl Fitter {
    pub fn new(bx: Basis, by: Basis) -> Self {
        let scratch = vec![0.0; 3 * bx.n.max(by.n)];
        Self {
            backgrounds: [separable_model::background(&bx), separable_model::background(&by)],
            bx,
            by,
            now: Atoms::default(),
            trial: Atoms::default(),
            residual: Vec::new(),
            trial_residual: Vec::new(),
            broadening: Default::default(),
            weighted: Vec::new(),
            tether: None,
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
            limit: f64::INFINITY,
            most_sources: 0.0,
            steps: 0,
            deadline: None,
        }
    }

    /// Fits `model` from where it stands, at most `steps` steps, and up to [`MOST_STEPS`] times as many while each brings much.
    pub fn fit(&mut self, reading: &Reading, model: &mut Model, steps: usize) {
        self.fit_below(reading, model, steps, f64::INFINITY);
    }

    /// The same, given up as soon as a deviance below `bar` is out of reach.
    pub fn fit_below(&mut self, reading: &Reading, model: &mut Model, steps: usize, bar: f64) {
        let last = self.steps + steps as u64;
        for _ in 0..PARTINGS {
            if self.tether.is_some() || self.steps + TOGETHER as u64 >= last {
                break;
            }
            let Some(groups) = model.groups() else { break };
            if !self.dispatch(reading, model, TOGETHER, bar) || model.converged {
                return;
            }
            let Some(moving) = self.moving(&groups) else { break };
            let rest = self.part(reading, &moving);
            let mut part = source_groups::only(model, &moving);
            let left = last.saturating_sub(self.steps) as usize;
            let goes_on = self.dispatch(&rest, &mut part, left, bar);
            for (&i, spot) in moving.iter().zip(&part.spots) {
                model.spots[i] = *spot;
            }
            if !goes_on {
                model.deviance = part.deviance;
                return;
            }
        }
        let left = last.saturating_sub(self.steps) as usize;
        self.dispatch(reading, model, left, bar);
    }

    /// `false` where the fit is given up.
    fn dispatch(&mut self, reading: &Reading, model: &mut Model, steps: usize, bar: f64) -> bool {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            reading,
            model,
            steps,
            bar,
            wants_information: false,
        })
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

    /// `false` where it is given up.
    #[inline(always)]
    fn run(&mut self, reading: &Reading, model: &mut Model, steps: usize, bar: f64) -> bool {
        let nuisances = model.nuisances;
        self.now.spots.clone_from(&model.spots);
        self.now.background = model.background;
        self.now.width = model.width;
        self.now.turn = model.turn;
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
        let mut goes_on = true;
        let mut is_brisk = false;
        let mut idle = 0;
        for k in 0..MOST_STEPS * steps {
            if converged || k >= steps && !is_brisk || idle >= IDLE_STEPS {
                break;
            }
            if self.work > BEYOND * self.most_work() {
                goes_on = false;
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
                let is_hopeless = |drop: f64| deviance - HOPE * drop > bar;
                // Damping hides what lies along a narrow valley.
                if is_hopeless(expected) && is_hopeless(self.promise(parameters)) {
                    goes_on = false;
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
                    let is_far = next > FAR_OFF * reading.numbers;
                    is_brisk = drop > BRISK * deviance;
                    idle = if is_far && drop < IDLE * deviance { idle + 1 } else { 0 };
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
        model.turn = self.now.turn;
        model.deviance = deviance - pull(&model.spots) - self.strain(&model.spots);
        // A fit of no steps only evaluates: it says nothing new about convergence.
        model.converged = converged || steps == 0 && model.converged;
        goes_on
    }

    /// Places the atoms of the present or the trial hypothesis, solves their amplitudes, and returns the deviance.
    #[inline(always)]
    fn evaluate(&mut self, reading: &Reading, nuisances: Nuisances, is_trial: bool) -> f64 {
        let atoms = if is_trial { &mut self.trial } else { &mut self.now };
        let backgrounds = [&self.backgrounds[0], &self.backgrounds[1]];
        atoms.place([&self.bx, &self.by], backgrounds, reading, nuisances, &mut self.scratch);
        self.solve_amplitudes(reading, is_trial);
        let spots = if is_trial { &self.trial.spots } else { &self.now.spots };
        pull(spots) + self.strain(spots) + self.subtract(reading, is_trial)
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
        reading.weight(residual, [&self.bx, &self.by], true, &mut self.scratch)
    }
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
    /// `false` where the fit was given up.
    type Output = bool;

    #[inline(always)]
    fn call(self) -> bool {
        let goes_on = self.fitter.run(self.reading, self.model, self.steps, self.bar);
        if self.wants_information {
            self.fitter.work += self.fitter.step_work(self.reading);
            self.fitter.linearise(self.reading, self.model.nuisances);
        }
        goes_on
    }
}
