//! What is remembered: all emitters' positions and velocities, the newest frames, and what older ones have left behind.

use nalgebra::{DVector, Vector6};

use crate::estimate::model::bases::Bases;
use crate::estimate::sequence::course::{SPEED_STD_M_S, accelerated};
use crate::estimate::sequence::joint_information::{JointInformation, STATE};
use crate::estimate::sequence::local_quadratic::{Energies, Engine, LocalQuadratic};
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::target::{Light, Target};
use crate::optics::Camera;

/// Standard deviations of χ² from which a frame contradicts what is remembered, as the flag `poor_fit` of one frame: nearer, noise alone would end the
/// memory within hours.
const UNEXPLAINED: f64 = 5.0;

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
    /// Of the newest pose; see `outlook`: where that of the next is sought.
    pub pose_error: Vector6<f64>,
}

impl Window {
    /// Of a camera that sees `ground_scale` metres of the ground for a metre of its sensor.
    pub fn empty(camera: &Camera, ground_scale: f64) -> Self {
        let unit_m = ground_scale * camera.spot_sigma_m;
        let extent = camera.x.half_width().max(camera.y.half_width()) * 2.0 / camera.spot_sigma_m + 4.0;
        Self {
            unknown: [extent * extent / 12.0, (SPEED_STD_M_S / unit_m).powi(2)],
            unit_m,
            ..Self::default()
        }
    }

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

    /// Takes a newest frame that was fitted on top of this.
    pub fn take(&mut self, mut fresh: Self) {
        for e in self.len()..fresh.len() {
            let at = |k: usize| fresh.state[STATE * e + k];
            self.insert(fresh.targets[e], [at(0), at(1)], [at(2), at(3)]);
        }
        for (target, fresh) in self.targets.iter_mut().zip(&fresh.targets) {
            target.straying = fresh.straying;
        }
        self.state = fresh.state;
        self.total = fresh.total;
        self.pose_error = fresh.snapshots.last().map_or(self.pose_error, |s| s.local.pose_error);
        self.snapshots.append(&mut fresh.snapshots);
        self.age += 1;
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
                let density = self.targets[e].straying.acceleration();
                let dt = next_s - snapshot.time_s;
                if density > 0.0 && dt > 0.0 {
                    let at: Vec<usize> = (STATE * e..STATE * (e + 1)).collect();
                    cost -= prior.add_noise(&at, &accelerated(density, dt, self.time_s - next_s));
                }
            }
        }
        self.prior = prior;
        self.total = self.sum(&self.state, self.snapshots.iter().map(|s| &s.local));
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

    /// The prior and all snapshots, linearised as in `locals`, about `state`.
    pub fn sum<'l>(
        &self,
        state: &DVector<f64>,
        locals: impl IntoIterator<Item = &'l LocalQuadratic>,
    ) -> JointInformation {
        let mut total = self.prior.clone();
        total.recentre(state);
        for (s, local) in self.snapshots.iter().zip(locals) {
            self.absorb(&mut total, local, s.time_s);
        }
        total
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

    /// Keeps of the snapshots those since which everybody has gone straight on, at `now_s`.
    pub fn keep_straight(&mut self, now_s: f64) {
        let span_s = (self.targets.iter()).fold(f64::INFINITY, |span_s, t| span_s.min(t.straying.straight_s()));
        let bent = self.snapshots.iter().take_while(|s| now_s - s.time_s > span_s).count();
        if bent > 0 {
            self.fold(bent);
        }
    }

    /// Takes a frame that came while this window was searched.
    pub fn catch_up(&mut self, engine: &mut Engine, newer: &Snapshot, memory_s: f64) {
        self.advance(newer.time_s, memory_s);
        self.snapshots.push(newer.clone());
        self.relinearise(engine, self.snapshots.len() - 1);
        self.step();
        self.pose_error = self.snapshots.last().map_or(self.pose_error, |s| s.local.pose_error);
        self.age += 1;
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
