//! The joint fit of all emitters' positions and velocities to the frames of a window, on top of what older frames have left behind.

use nalgebra::DVector;

use crate::estimate::model::bases::Bases;
use crate::estimate::model::hypothesis::OVERLAPPING;
use crate::estimate::sequence::joint_information::{JointInformation, STATE};
use crate::estimate::sequence::local_quadratic::{Energies, Engine, LocalQuadratic};
use crate::estimate::sequence::motion::accelerated;
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::target::{Light, Target};

/// Damping λ: first value and range, as in the fit of one frame.
const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-12;
const LAMBDA_CEILING: f64 = 1e8;
/// Converged when the predicted decrease of the next step is below this: 3 % of a standard deviation.
const NEGLIGIBLE_DECREASE: f64 = 1e-3;
/// Longest step of a position in one iteration, σ: the model is not linear farther out.
const LONGEST_STEP: f64 = 0.5;

/// Standard deviations of χ² from which a frame contradicts what is remembered, as the flag `poor_fit` of one frame: nearer, noise alone would end the
/// memory within hours.
const UNEXPLAINED: f64 = 5.0;
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

/// All that is remembered.
#[derive(Clone, Default)]
pub(crate) struct Window {
    pub targets: Vec<Target>,
    /// The time of `state`, s since the epoch.
    pub time_s: f64,
    /// Position, σ, and velocity, σ/s, of each target.
    pub state: DVector<f64>,
    /// What frames that have left the window say, at `time_s`.
    pub prior: JointInformation,
    pub snapshots: Vec<Snapshot>,
    /// The prior and all snapshots, about `state`.
    pub total: JointInformation,
    /// Snapshots of noise alone that were left out; see `subspace`.
    pub dropped: f64,
    /// −2 ln L of the last fit, and the damping λ it ended with; 0 to begin with `LAMBDA_START`.
    pub cost: f64,
    pub damping: f64,
    pub energies: Energies,
    /// Variances of position, σ², and velocity, σ²/s², of an emitter of which nothing is known.
    pub unknown: [f64; 2],
    /// Metres on the ground of a σ.
    pub unit_m: f64,
    /// Frames that it has seen.
    pub age: usize,
}

impl Window {
    pub fn len(&self) -> usize {
        self.targets.len()
    }

    /// Indices of the targets that a frame at `time_s` may hold.
    pub fn present(&self, time_s: f64) -> Vec<usize> {
        (0..self.len()).filter(|&e| self.targets[e].is_in(time_s)).collect()
    }

    /// The target's place, σ.
    pub fn place(&self, e: usize) -> [f64; 2] {
        [self.state[STATE * e], self.state[STATE * e + 1]]
    }

    /// Who of the present targets is within `reach`, σ, of one of these places.
    pub fn beside(&self, places: &[[f64; 2]], reach: f64) -> Vec<usize> {
        let is_near = |[x, y]: [f64; 2]| places.iter().any(|at| (x - at[0]).hypot(y - at[1]) < reach);
        let mut beside = self.present(self.time_s);
        beside.retain(|&e| is_near(self.place(e)));
        beside
    }

    /// Places of the targets that a frame at `time_s` may hold.
    pub fn places(&self, state: &DVector<f64>, time_s: f64) -> DVector<f64> {
        let dt = time_s - self.time_s;
        let at = self.present(time_s).into_iter();
        let at: Vec<f64> = at
            .flat_map(|e| [0, 1].map(|k| state[STATE * e + k] + dt * state[STATE * e + 2 + k]))
            .collect();
        DVector::from_vec(at)
    }

    /// Positions on the sensor, σ, of the targets that the newest frame may hold.
    pub fn positions(&self, bases: &Bases) -> DVector<f64> {
        let places = self.places(&self.state, self.time_s);
        match self.snapshots.last() {
            Some(newest) => newest.positions(bases, places),
            None => places,
        }
    }

    /// Moves state and knowledge to `time_s`; what has left the window fades with the time constant `memory_s`.
    pub fn advance(&mut self, time_s: f64, memory_s: f64) {
        let dt = time_s - self.time_s;
        let lost = 1.0 - (-dt / memory_s).exp();
        self.total.gradient -= lost * self.prior.gradient_at(&self.total.at);
        self.total.information -= lost * &self.prior.information;
        self.prior.gradient *= 1.0 - lost;
        self.prior.information *= 1.0 - lost;
        self.time_s = time_s;
        for e in 0..self.len() {
            for k in STATE * e..STATE * e + 2 {
                self.state[k] += dt * self.state[k + 2];
            }
        }
        self.prior.propagate(dt);
        self.total.propagate(dt);
    }

    /// Adds a target; every snapshot from `target.born_s` on may hold it.
    pub fn insert(&mut self, target: Target, position: [f64; 2], velocity: [f64; 2]) {
        let n = self.state.len();
        self.state = self.state.clone().resize_vertically(n + STATE, 0.0);
        let state = [position[0], position[1], velocity[0], velocity[1]];
        self.state.as_mut_slice()[n..].copy_from_slice(&state);
        self.prior.insert(state, self.unknown);
        self.total.insert(state, self.unknown);
        self.targets.push(target);
    }

    /// Forgets a target, and that any snapshot held it. The caller fits again.
    pub fn remove(&mut self, e: usize) {
        self.targets.remove(e);
        let kept = self.state.as_slice().chunks_exact(STATE).enumerate();
        let kept: Vec<f64> = kept.filter(|(k, _)| *k != e).flat_map(|(_, s)| s.to_vec()).collect();
        self.state = DVector::from_vec(kept);
        self.prior.marginalise(e);
        self.total.marginalise(e);
    }

    /// Moves the `count` oldest snapshots into the prior, from each to the next of which the emitters may have accelerated. Returns what this takes off the cost of the state.
    pub fn fold(&mut self, count: usize) -> f64 {
        let mut prior = std::mem::take(&mut self.prior);
        let mut cost = prior.cost(&self.state);
        prior.recentre(&self.state);
        let next_s: Vec<f64> = self
            .snapshots
            .iter()
            .skip(1)
            .map(|s| s.time_s)
            .chain([self.time_s])
            .collect();
        for (snapshot, next_s) in self
            .snapshots
            .drain(..count)
            .collect::<Vec<_>>()
            .into_iter()
            .zip(next_s)
        {
            cost += snapshot.local.cost(&self.places(&self.state, snapshot.time_s));
            self.absorb(&mut prior, &snapshot.local, snapshot.time_s);
            for (e, light) in self.present(snapshot.time_s).into_iter().zip(snapshot.local.lights()) {
                self.targets[e].folded.add(light);
                let density = self.targets[e].straying.acceleration() / (self.unit_m * self.unit_m);
                let dt = next_s - snapshot.time_s;
                if density > 0.0 && dt > 0.0 {
                    let at: Vec<usize> = (STATE * e..STATE * (e + 1)).collect();
                    prior.add_noise(&at, &accelerated(density, dt, self.time_s - next_s));
                }
            }
        }
        self.prior = prior;
        cost
    }

    /// Forgets who died before the first snapshot that is left.
    pub fn forget_dead(&mut self) {
        let first_s = self.snapshots.first().map_or(self.time_s, |s| s.time_s);
        for e in (0..self.len())
            .rev()
            .filter(|&e| self.targets[e].died_s <= first_s)
            .collect::<Vec<_>>()
        {
            self.remove(e);
        }
    }

    /// Adds a snapshot's likelihood to `knowledge`.
    pub fn absorb(&self, knowledge: &mut JointInformation, local: &LocalQuadratic, time_s: f64) {
        let shift = self.places(&knowledge.at, time_s) - &local.positions;
        let gradient = &local.gradient - &local.information * shift;
        knowledge.absorb(
            &self.present(time_s),
            time_s - self.time_s,
            &gradient,
            &local.information,
        );
    }

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

    /// The prior and all snapshots, linearised as in `locals`, about `state`.
    fn sum<'l>(&self, state: &DVector<f64>, locals: impl IntoIterator<Item = &'l LocalQuadratic>) -> JointInformation {
        let mut total = self.prior.clone();
        total.recentre(state);
        for (s, local) in self.snapshots.iter().zip(locals) {
            self.absorb(&mut total, local, s.time_s);
        }
        total
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
            let predicted = step.dot(&total.gradient);
            if predicted < NEGLIGIBLE_DECREASE && lambda <= LAMBDA_START {
                progress = Progress::Converged;
                break;
            }
            if lambda <= LAMBDA_START && cost - ABORT_FACTOR * predicted > highest {
                progress = Progress::Hopeless;
                break;
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
            } else {
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

    /// What the light of each target weighs in the snapshots.
    pub fn lights(&self) -> Vec<Light> {
        let dropped = Light {
            evidence: 0.0,
            lit: self.dropped,
        };
        let mut sums = vec![dropped; self.len()];
        for s in &self.snapshots {
            for (e, light) in self.present(s.time_s).into_iter().zip(s.local.lights()) {
                sums[e].add(light);
            }
        }
        sums
    }

    /// Whether noise alone explains what the newest snapshot leaves.
    pub fn is_last_explained(&self) -> bool {
        self.snapshots.last().is_some_and(|last| {
            let emitters = self.present(last.time_s).len() as f64;
            let freedom = (last.compressed.data_count - 3.0 * emitters).max(1.0);
            last.local.deviance < freedom + UNEXPLAINED * (2.0 * freedom).sqrt() + UNEXPLAINED
        })
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
    fn relinearise(&mut self, engine: &mut Engine, k: usize) {
        let places = self.places(&self.state, self.snapshots[k].time_s);
        self.snapshots[k].local = self.snapshots[k].about(engine, self.energies, places);
    }

    /// Linearises the newest snapshot anew, as when one of its targets has turned out to be dark.
    pub fn relinearise_last(&mut self, engine: &mut Engine) {
        self.relinearise(engine, self.snapshots.len() - 1);
        self.step();
    }

    /// Adds up the prior and the snapshots as they are linearised, and takes a Gauss–Newton step.
    fn step(&mut self) {
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

    /// Keeps of the snapshots those since which everybody has gone straight on, at `now_s`.
    pub fn keep_straight(&mut self, now_s: f64) {
        let spans = self.targets.iter().map(|t| {
            let density = t.straying.acceleration() / (self.unit_m * self.unit_m);
            if density > 0.0 {
                t.straying.straight_s(density)
            } else {
                f64::INFINITY
            }
        });
        let span_s = spans.fold(f64::INFINITY, f64::min);
        let bent = self.snapshots.iter().take_while(|s| now_s - s.time_s > span_s).count();
        if bent > 0 {
            self.fold(bent);
            self.total = self.sum(&self.state, self.snapshots.iter().map(|s| &s.local));
        }
    }

    /// Goes on with frames that came while this window was searched.
    pub fn catch_up(&mut self, engine: &mut Engine, newer: &[Snapshot], memory_s: f64) {
        for s in newer {
            self.advance(s.time_s, memory_s);
            self.snapshots.push(s.clone());
            self.relinearise(engine, self.snapshots.len() - 1);
            self.step();
        }
    }

    /// Forgets targets, highest index first, and that any snapshot held them.
    pub fn discard(&mut self, engine: &mut Engine, targets: &[usize]) {
        for &e in targets {
            let born_s = self.targets[e].born_s;
            self.remove(e);
            for k in 0..self.snapshots.len() {
                if self.snapshots[k].time_s >= born_s {
                    self.relinearise(engine, k);
                }
            }
        }
        if !targets.is_empty() {
            self.step();
        }
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
