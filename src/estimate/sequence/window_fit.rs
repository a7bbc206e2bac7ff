//! The joint fit of all emitters' positions and velocities to the frames of a window.

use nalgebra::DVector;

use crate::estimate::model::hypothesis::OVERLAPPING;
use crate::estimate::sequence::joint_information::STATE;
use crate::estimate::sequence::local_quadratic::{Engine, LocalQuadratic};
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::window::Window;

/// Damping λ: first value and range, as in the fit of one frame.
const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-12;
const LAMBDA_CEILING: f64 = 1e8;
/// Converged when the predicted decrease of the next step is below this: 3 % of a standard deviation.
const NEGLIGIBLE_DECREASE: f64 = 1e-3;
/// Longest step of a position in one iteration, σ: the model is not linear farther out.
const LONGEST_STEP: f64 = 0.5;

/// A snapshot is linearised anew when a position has moved by this many σ since, or, where another emitter is within `OVERLAPPING`, by this share
/// of the distance to it: the information on the pair's difference changes with that distance. Smaller takes time, larger leaves biases beyond the
/// standard deviation in pairs of much light.
const MOVED: f64 = 0.02;
const MOVED_OVERLAPPING: f64 = 0.002;

/// Times the predicted decrease that must suffice to reach the cost asked for; see `fit::levenberg_marquardt`.
const ABORT_FACTOR: f64 = 5.0;

/// How a fit ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    Converged,
    /// The cost asked for is out of reach.
    Hopeless,
    /// Steps or work are spent.
    Unfinished,
}

impl Window {
    /// Linearises all snapshots at `state`. Returns −2 ln L, and prior and snapshots together.
    fn linearise(&self, engine: &mut Engine, state: &DVector<f64>, locals: &mut Vec<LocalQuadratic>) -> f64 {
        locals.clear();
        let mut cost = self.prior.cost(state);
        for s in &self.snapshots {
            let local = s.about(engine, self.energies, self.places(state, s.time_s));
            cost += local.deviance;
            locals.push(local);
        }
        cost
    }

    /// Fits all snapshots and the prior together by Levenberg–Marquardt, at most `steps` steps from `state` on. Sets `total` and `cost`.
    pub fn fit(&mut self, engine: &mut Engine, steps: usize) {
        self.damping = 0.0;
        self.fit_below(engine, &mut { steps }, f64::INFINITY);
    }

    /// [`Window::fit`] of the `steps` that are left, given up as soon as a cost below `highest` is out of reach. Called again, it goes on.
    pub fn fit_below(&mut self, engine: &mut Engine, steps: &mut usize, highest: f64) -> Progress {
        let mut locals = Vec::new();
        let mut trial = Vec::new();
        let is_linear = self.damping > 0.0;
        let mut cost = if is_linear {
            locals.extend(self.snapshots.iter_mut().map(|s| s.local.take()));
            self.cost
        } else {
            self.linearise(engine, &self.state.clone(), &mut locals)
        };
        let mut total = self.sum(&self.state, &locals);
        let mut lambda = if is_linear { self.damping } else { LAMBDA_START };
        let mut progress = Progress::Unfinished;
        if self.len() == 0 {
            progress = Progress::Converged;
        }
        let span = self.snapshots.first().map_or(0.0, |s| (self.time_s - s.time_s).abs());
        let mut was_rejected = false;
        while progress == Progress::Unfinished && *steps > 0 && !engine.budget.is_exhausted() {
            *steps -= 1;
            let Some(factor) = total.factor(lambda) else {
                lambda *= 4.0;
                if lambda > LAMBDA_CEILING {
                    break;
                }
                continue;
            };
            let mut step = factor.solve(&total.gradient);
            let mut predicted = step.dot(&total.gradient);
            let ends = |predicted: f64| {
                if predicted < NEGLIGIBLE_DECREASE {
                    Some(Progress::Converged)
                } else {
                    (cost - ABORT_FACTOR * predicted > highest).then_some(Progress::Hopeless)
                }
            };
            if lambda <= LAMBDA_START && ends(predicted).is_some() {
                // Damping holds back what is known little beside the rest, as where all emitters are together by a moving platform's pose.
                if let Some(factor) = total.factor(LAMBDA_FLOOR).filter(|_| !was_rejected) {
                    lambda = LAMBDA_FLOOR;
                    step = factor.solve(&total.gradient);
                    predicted = step.dot(&total.gradient);
                }
                if let Some(end) = ends(predicted) {
                    progress = end;
                    break;
                }
            }
            shorten(&mut step, span);
            let next = &self.state + &step;
            let next_cost = self.linearise(engine, &next, &mut trial);
            if next_cost <= cost {
                cost = next_cost;
                self.state = next;
                std::mem::swap(&mut locals, &mut trial);
                total = self.sum(&self.state, &locals);
                lambda = (0.15 * lambda).max(LAMBDA_FLOOR);
                was_rejected = false;
            } else {
                was_rejected = true;
                lambda *= 4.0;
                if lambda > LAMBDA_CEILING {
                    progress = Progress::Converged;
                    break;
                }
            }
        }
        for (s, local) in self.snapshots.iter_mut().zip(locals) {
            s.local = local;
        }
        self.total = total;
        (self.cost, self.damping) = (cost, lambda);
        progress
    }

    /// How far positions have moved since each snapshot was linearised: 1 and more where it needs a new linearisation.
    fn staleness(&self) -> Vec<f64> {
        let n = self.len();
        let at = |e: usize| [self.state[STATE * e], self.state[STATE * e + 1]];
        let reach: Vec<f64> = (0..n)
            .map(|e| {
                let apart = |f: usize| (at(e)[0] - at(f)[0]).hypot(at(e)[1] - at(f)[1]);
                let nearest = (0..n).filter(|f| *f != e).map(apart).fold(f64::INFINITY, f64::min);
                if nearest > OVERLAPPING {
                    MOVED
                } else {
                    MOVED_OVERLAPPING * nearest.min(1.0)
                }
            })
            .collect();
        let of = |s: &Snapshot| {
            let moved = self.places(&self.state, s.time_s) - &s.local.positions;
            let shares = self.present(s.time_s).into_iter().zip(moved.as_slice().chunks_exact(2));
            shares.map(|(e, d)| d[0].hypot(d[1]) / reach[e]).fold(0.0, f64::max)
        };
        self.snapshots.iter().map(of).collect()
    }

    /// Linearises anew the snapshots that need it most, at most `most` of them, and takes a Gauss–Newton step. Returns whether any did.
    pub fn refresh(&mut self, engine: &mut Engine, most: usize) -> bool {
        let mut stale: Vec<(usize, f64)> = self
            .staleness()
            .into_iter()
            .enumerate()
            .filter(|(_, s)| *s > 1.0)
            .collect();
        if stale.is_empty() {
            return false;
        }
        stale.sort_by(|a, b| b.1.total_cmp(&a.1));
        stale.truncate(most);
        for (k, _) in stale {
            self.relinearise(engine, k);
        }
        self.step();
        true
    }

    /// Linearises one snapshot at the state. The caller adds up anew.
    pub fn relinearise(&mut self, engine: &mut Engine, k: usize) {
        let places = self.places(&self.state, self.snapshots[k].time_s);
        self.snapshots[k].local = self.snapshots[k].about(engine, self.energies, places);
    }

    /// Linearises the newest snapshot anew, as when one of its targets has turned out to be dark.
    pub fn relinearise_last(&mut self, engine: &mut Engine) {
        self.relinearise(engine, self.snapshots.len() - 1);
        self.step();
    }

    /// What the best step takes off −2 ln L, as the snapshots are linearised.
    pub fn decrease(&self) -> f64 {
        let total = self.sum(&self.state, self.snapshots.iter().map(|s| &s.local));
        let factor = total.factor(LAMBDA_FLOOR);
        factor.map_or(0.0, |factor| factor.solve(&total.gradient).dot(&total.gradient))
    }

    /// Adds up the prior and the snapshots as they are linearised, and takes a Gauss–Newton step.
    pub fn step(&mut self) {
        let mut total = self.sum(&self.state, self.snapshots.iter().map(|s| &s.local));
        if let Some(factor) = total.factor(LAMBDA_FLOOR) {
            let span = self.snapshots.first().map_or(0.0, |s| (self.time_s - s.time_s).abs());
            let mut step = factor.solve(&total.gradient);
            shorten(&mut step, span);
            self.state += step;
            total.recentre(&self.state);
        }
        self.total = total;
    }
}

/// Shortens each emitter's step to what the model is linear over.
fn shorten(step: &mut DVector<f64>, span: f64) {
    for s in step.as_mut_slice().chunks_exact_mut(STATE) {
        let longest = s[0].abs().max(s[1].abs()).max(span * s[2].abs()).max(span * s[3].abs());
        if longest > LONGEST_STEP {
            s.iter_mut().for_each(|v| *v *= LONGEST_STEP / longest);
        }
    }
}
