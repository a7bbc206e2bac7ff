//! The estimator `sequence`: what happens with a frame.

use std::sync::Arc;

use jiff::Timestamp;
use nalgebra::{DMatrix, DVector};

use crate::estimate::emitter::{Estimate, Flags};
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::EstimatorSpec;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::hypothesis::Nuisances;
use crate::estimate::rules::Rules;
use crate::estimate::sequence::joint_information::{JointInformation, STATE};
use crate::estimate::sequence::motion::{Posterior, posterior, velocity_on_ground};
use crate::estimate::sequence::search::WindowSearch;
use crate::estimate::sequence::snapshot::{Engine, LocalQuadratic, Snapshot, hypothesis};
use crate::estimate::sequence::window::{SPEED_STD_M_S, Target, Window};
use crate::estimate::uncertainty::localise::localise;
use crate::frame::Frame;
use crate::optics::Camera;

/// Evidence, ln, that a target has gone dark before it is dropped: false once in a million.
const DARK: f64 = 14.0;
/// Frames nearer in time than this count as one draw of the fading, s: the coherence time of a turbulent atmosphere.
const COHERENCE_S: f64 = 0.01;
/// Standard deviation of a change of velocity, m/s: a walker who turns round; a car changes its by as much within two seconds.
const MANOEUVRE_M_S: f64 = 3.0;
/// Frames of the window, and the numbers that all of them may hold: bounds memory, and the time of a fit of the whole window.
const MAX_SNAPSHOTS: usize = 128;
const MAX_NUMBERS: usize = 1 << 20;
/// Steps of a fit to a new frame, and of the whole window.
const FRAME_STEPS: usize = 12;
const WINDOW_STEPS: usize = 30;
/// The window is searched when it has grown by this factor since, and at the latest after this many frames.
const SEARCH_GROWTH: f64 = 1.4;
const SEARCH_AFTER: usize = 32;
/// Work of a search of the window, in frames' searches: it comes with one frame in `SEARCH_AFTER`.
const SEARCH_WORK: f64 = 4.0;

/// An estimator that remembers.
pub(crate) struct SequenceEstimator {
    spec: &'static EstimatorSpec,
    single: AnalyticEstimator,
    camera: Camera,
    rules: Rules,
    /// Times are seconds since this.
    epoch: Option<Timestamp>,
    window: Window,
    /// Frames since the last search, and the window's length then.
    since_search: usize,
    searched: usize,
    /// Gap after which nothing is remembered, s.
    memory_s: f64,
}

impl SequenceEstimator {
    pub fn new(
        spec: &'static EstimatorSpec,
        single: AnalyticEstimator,
        camera: &Camera,
        memory_s: f64,
        rules: Rules,
    ) -> Self {
        Self {
            spec,
            single,
            camera: camera.clone(),
            rules,
            epoch: None,
            window: Window::default(),
            since_search: 0,
            searched: 0,
            memory_s,
        }
    }

    /// Metres on the ground of one σ on the sensor.
    fn ground_m(&self) -> f64 {
        self.camera.ground_scale() * self.camera.spot_sigma_m
    }

    fn forget(&mut self) {
        let extent = self.camera.x.half_width().max(self.camera.y.half_width()) * 2.0 / self.camera.spot_sigma_m + 4.0;
        self.window = Window {
            unknown: [extent * extent / 12.0, (SPEED_STD_M_S / self.ground_m()).powi(2)],
            ..Window::default()
        };
        self.since_search = 0;
        self.searched = 0;
    }
}

impl Estimator for SequenceEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let scale = self.single.load(frame)?;
        let epoch = *self.epoch.get_or_insert(frame.time);
        let time_s = frame.time.duration_since(epoch).as_secs_f64();
        let elapsed = time_s - self.window.time_s;
        if self.window.snapshots.is_empty() || !(elapsed > 0.0 && elapsed <= self.memory_s) {
            self.forget();
            self.window.time_s = time_s;
        }
        self.window.advance(time_s, self.memory_s);
        if let Some(alone) = self.take(time_s, elapsed, scale, is_over) {
            return Ok(alone);
        }
        self.bury(elapsed, is_over);
        self.tend(is_over);
        Ok(self.report(scale, is_over))
    }
}

impl SequenceEstimator {
    /// Takes the loaded frame into the window. Where the model explains it in no way, what it shows alone is returned, and what is
    /// remembered stays as it is.
    fn take(&mut self, time_s: f64, elapsed: f64, scale: f64, is_over: &dyn Fn() -> bool) -> Option<Estimate> {
        let mut budget = WorkBudget::new(is_over);
        let is_even = self.single.loaded().1.variance.is_constant();
        if is_even && self.window.len() > 0 {
            let fresh = self.fresh(self.window.total.clone(), time_s);
            if let Some(fresh) = self.fit_fresh(fresh, &mut budget) {
                self.accept(fresh);
                return None;
            }
            // Somebody has turned or stopped: the same with a manoeuvre since the frame before.
            let mut opened = self.window.total.clone();
            self.open(&mut opened, elapsed);
            let fresh = self.fresh(opened, time_s);
            if let Some(fresh) = self.fit_fresh(fresh, &mut budget) {
                let all = self.window.snapshots.len();
                self.window.fold(all);
                let mut prior = std::mem::take(&mut self.window.prior);
                self.open(&mut prior, elapsed);
                self.window.prior = prior;
                self.accept(fresh);
                return None;
            }
        }
        if is_even && self.search_again(time_s, is_over) {
            return None;
        }
        // What is remembered is wrong where this frame alone is explained and its prediction is not.
        let found = self.single.estimate_loaded(scale, is_over);
        let mut alone = Window {
            targets: Vec::new(),
            state: DVector::zeros(0),
            ..self.fresh(JointInformation::default(), time_s)
        };
        for emitter in &found.emitters {
            let at = emitter.sensor_m.map(|v| v / self.camera.spot_sigma_m);
            alone.insert(Target::born(time_s), at, [0.0; 2]);
        }
        let fitted = if is_even {
            self.fit_fresh(alone, &mut budget)
        } else {
            None
        };
        let Some(alone) = fitted else { return Some(found) };
        if self.window.len() > 0 {
            self.forget();
            self.window.time_s = time_s;
        }
        self.accept(alone);
        None
    }

    /// Searches the frames of the window together with the loaded one, as what is remembered may be wrong. Whether that explains it.
    fn search_again(&mut self, time_s: f64, is_over: &dyn Fn() -> bool) -> bool {
        let Some(first) = self.window.snapshots.first() else {
            return false;
        };
        let born_s = first.time_s;
        let mut next = self.window.clone();
        next.snapshots
            .append(&mut self.fresh(JointInformation::default(), time_s).snapshots);
        let rules = self.rules;
        let mut budget = WorkBudget::of_frames(SEARCH_WORK, is_over);
        let (space, _, _) = self.single.loaded();
        let mut engine = Engine {
            bases: &space.bases,
            rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        next.fit(&mut engine, WINDOW_STEPS);
        let mut search = WindowSearch {
            engine: &mut engine,
            matched_filter: &mut space.matched_filter,
            penalty: space.source_penalty,
        };
        search.refine(&mut next, born_s);
        let is_explained = next.is_last_explained();
        if is_explained {
            self.window = next;
        }
        is_explained
    }

    /// Adds to `knowledge` that every emitter may have changed its velocity since the frame before.
    fn open(&self, knowledge: &mut JointInformation, elapsed: f64) {
        let speed = (MANOEUVRE_M_S / self.ground_m()).powi(2);
        for e in 0..knowledge.len() {
            let at: Vec<usize> = (0..STATE).map(|k| STATE * e + k).collect();
            let noise = DMatrix::from_fn(STATE, STATE, |r, c| {
                let place = |k: usize| if k < 2 { 0.5 * elapsed } else { 1.0 };
                let shared = if r % 2 == c % 2 {
                    speed * place(r) * place(c)
                } else {
                    0.0
                };
                // Half of the position's is its own: when the manoeuvre was is not known.
                if r == c { 1.2 * shared + 1e-12 } else { shared }
            });
            knowledge.add_noise(&at, &noise);
        }
    }

    /// A window of the loaded frame alone, on top of `prior`.
    fn fresh(&mut self, prior: JointInformation, time_s: f64) -> Window {
        let (targets, state) = (self.window.targets.clone(), self.window.state.clone());
        let unknown = self.window.unknown;
        let (_, compressed, _) = self.single.loaded();
        Window {
            targets,
            time_s,
            state,
            prior,
            unknown,
            snapshots: vec![Snapshot {
                time_s,
                compressed: Arc::new(compressed.clone()),
                nuisances: Nuisances::default(),
                local: LocalQuadratic::default(),
            }],
            ..Window::default()
        }
    }

    /// Makes a fitted newest frame part of the window.
    fn accept(&mut self, mut fresh: Window) {
        let window = &mut self.window;
        for e in window.len()..fresh.len() {
            let at = |k: usize| fresh.state[STATE * e + k];
            window.insert(fresh.targets[e], [at(0), at(1)], [at(2), at(3)]);
        }
        window.targets = fresh.targets;
        window.state = fresh.state;
        window.total = fresh.total;
        window.snapshots.append(&mut fresh.snapshots);
    }

    /// Fits the newest frame to what is remembered, with births; `None` where that does not explain it.
    fn fit_fresh(&mut self, mut fresh: Window, budget: &mut WorkBudget) -> Option<Window> {
        let rules = self.rules;
        let time_s = fresh.time_s;
        let (space, _, _) = self.single.loaded();
        let mut engine = Engine {
            bases: &space.bases,
            rules,
            budget,
            workspace: &mut space.workspace,
        };
        fresh.fit(&mut engine, FRAME_STEPS);
        let mut search = WindowSearch {
            engine: &mut engine,
            matched_filter: &mut space.matched_filter,
            penalty: space.source_penalty,
        };
        search.grow(&mut fresh, time_s);
        fresh.is_last_explained().then_some(fresh)
    }

    /// Ends targets that have gone dark: frames before hold them still.
    fn bury(&mut self, elapsed: f64, is_over: &dyn Fn() -> bool) {
        let window = &mut self.window;
        let Some(last) = window.snapshots.last() else { return };
        let (time_s, weight) = (last.time_s, (elapsed / COHERENCE_S).clamp(0.0, 1.0));
        let mut has_died = false;
        for (i, e) in window.present(time_s).into_iter().enumerate() {
            let target = &mut window.targets[e];
            target.weigh(last.local.energies[i], last.local.energy_variances[i], weight);
            if target.darkness > DARK {
                target.died_s = time_s;
                has_died = true;
            }
        }
        if has_died {
            let mut budget = WorkBudget::of_frames(SEARCH_WORK, is_over);
            let (space, _, _) = self.single.loaded();
            let mut engine = Engine {
                bases: &space.bases,
                rules: self.rules,
                budget: &mut budget,
                workspace: &mut space.workspace,
            };
            self.window.fit(&mut engine, WINDOW_STEPS);
        }
    }

    /// Keeps the window within its bounds, linearised and searched.
    fn tend(&mut self, is_over: &dyn Fn() -> bool) {
        let rules = self.rules;
        let mut budget = WorkBudget::of_frames(SEARCH_WORK, is_over);
        let (space, compressed, _) = self.single.loaded();
        let numbers = (compressed.mx * compressed.my).max(1);
        let most = MAX_SNAPSHOTS.min(MAX_NUMBERS / numbers).max(2);
        let mut engine = Engine {
            bases: &space.bases,
            rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        let window = &mut self.window;
        if window.snapshots.len() > most {
            window.fold(window.snapshots.len() - most);
        }
        window.forget_dead();
        if window.has_moved() {
            window.fit(&mut engine, WINDOW_STEPS);
        }
        self.since_search += 1;
        let length = window.snapshots.len();
        if length < 2 || self.since_search < SEARCH_AFTER && (length as f64) < SEARCH_GROWTH * self.searched as f64 {
            return;
        }
        (self.since_search, self.searched) = (0, length);
        let mut search = WindowSearch {
            engine: &mut engine,
            matched_filter: &mut space.matched_filter,
            penalty: space.source_penalty,
        };
        let is_ambiguous = window.is_ambiguous();
        let born_s = window.snapshots[0].time_s;
        let has_grown = search.grow(window, born_s);
        if is_ambiguous || has_grown {
            search.refine(window, born_s);
            search.restart(window);
        }
    }

    /// The emitters at the newest frame's time.
    fn report(&mut self, scale: f64, is_over: &dyn Fn() -> bool) -> Estimate {
        let sigma = self.camera.spot_sigma_m;
        let window = &self.window;
        let present = window.present(window.time_s);
        let n = present.len();
        let posterior = posterior(&window.total, 1.0 / (self.camera.ground_scale() * sigma));
        let mut known = DMatrix::zeros(2 * n, 2 * n);
        let mut positions = window.positions(&window.state, window.time_s);
        let mut budget = WorkBudget::new(is_over);
        let (space, compressed, frame) = self.single.loaded();
        if let Some(Posterior { state, covariance }) = &posterior {
            positions = window.positions(state, window.time_s);
            let place = |k: usize| STATE * present[k / 2] + k % 2;
            let own = DMatrix::from_fn(2 * n, 2 * n, |r, c| covariance[(place(r), place(c))]);
            let mut engine = Engine {
                bases: &space.bases,
                rules: self.rules,
                budget: &mut budget,
                workspace: &mut space.workspace,
            };
            let local = LocalQuadratic::new(&mut engine, compressed, Nuisances::default(), positions.clone());
            if let Some(information) = own.cholesky().map(|c| c.inverse()) {
                known = information - local.information;
            }
        }
        let mut hypothesis = hypothesis(&positions, Nuisances::default());
        hypothesis.converged = true;
        let mut context = FitContext {
            bases: &space.bases,
            compressed,
            rules: self.rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        let noise_j = scale * self.camera.noise_std_j;
        let mut found = localise(
            &mut context,
            &mut hypothesis,
            frame,
            &self.camera,
            noise_j,
            None,
            Some(&known),
        );
        for (e, emitter) in found.emitters.iter_mut().enumerate() {
            emitter.energy_j = emitter.energy_j.max(0.0);
            if let Some(Posterior { state, .. }) = &posterior {
                let velocity = [2, 3].map(|k| state[STATE * present[e] + k] * sigma);
                emitter.velocity = Some(velocity_on_ground(&self.camera, emitter.sensor_m, velocity));
            }
            if is_over() {
                emitter.flags |= Flags::OUT_OF_TIME;
            }
        }
        Estimate {
            emitters: found.emitters,
            estimator: self.spec.name,
            is_cut_short: is_over(),
            is_limited: n >= compressed.max_sources(),
            reduced_chi2: found.reduced_chi2,
            spot_error: 0.0,
            saturated_share: frame.saturated_share(),
            condition: found.condition,
            steps: budget.steps,
        }
    }
}
