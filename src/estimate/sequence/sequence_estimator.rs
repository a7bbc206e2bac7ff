//! The estimator `sequence`: what happens with a frame.

use std::sync::Arc;

use jiff::Timestamp;
use nalgebra::{DMatrix, DVector};

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::EstimatorSpec;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::hypothesis::Nuisances;
use crate::estimate::rules::Rules;
use crate::estimate::sequence::joint_information::{JointInformation, STATE};
use crate::estimate::sequence::report::report;
use crate::estimate::sequence::residual_map::ResidualSum;
use crate::estimate::sequence::revision::{Revised, Revision};
use crate::estimate::sequence::search::{WindowSearch, unconfirmed};
use crate::estimate::sequence::snapshot::{Engine, LocalQuadratic, Snapshot};
use crate::estimate::sequence::target::Target;
use crate::estimate::sequence::window::{SPEED_STD_M_S, Window};
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
/// Snapshots that are linearised anew with a frame: more follow a change sooner, each costs as much as a step of the frame's own fit.
const REFRESHED: usize = 8;
/// A search of the window begins when it has grown by this factor since the last, and at the latest after this many frames.
const SEARCH_GROWTH: f64 = 1.4;
const SEARCH_AFTER: usize = 32;
/// Work of a search that has to end with its frame, in frames' searches: where what is remembered explains nothing.
const SEARCH_WORK: f64 = 0.5;
/// Work of a search that goes on from frame to frame, a frame: less finds emitters later, more makes frames slower.
const REVISION_WORK: f64 = 0.04;

/// An estimator that remembers.
pub(crate) struct SequenceEstimator {
    spec: &'static EstimatorSpec,
    single: AnalyticEstimator,
    camera: Camera,
    rules: Rules,
    /// Times are seconds since this.
    epoch: Option<Timestamp>,
    window: Window,
    /// What frames have left unexplained since the number of emitters changed.
    left: ResidualSum,
    /// The search in progress; frames since it began, and the window's length then.
    revision: Option<Revision>,
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
            left: ResidualSum::default(),
            revision: None,
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
        self.left.clear();
        self.revision = None;
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
        self.drop_unconfirmed(is_over);
        self.tend(is_over);
        self.revise(is_over);
        let name = self.spec.name;
        Ok(report(
            &mut self.single,
            &self.window,
            &self.camera,
            self.rules,
            name,
            scale,
            is_over,
        ))
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
            left: Vec::new(),
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
            left: Vec::new(),
        };
        let has_grown = search.grow(&mut fresh, time_s);
        let left = search.left;
        let is_explained = fresh.is_last_explained();
        if has_grown {
            self.left.clear();
        } else if is_explained {
            self.left.add(&left, MAX_SNAPSHOTS as f64);
        }
        is_explained.then_some(fresh)
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

    /// Forgets newcomers that the frames since have not confirmed.
    fn drop_unconfirmed(&mut self, is_over: &dyn Fn() -> bool) {
        let mut budget = WorkBudget::new(is_over);
        let (space, _, _) = self.single.loaded();
        let targets = unconfirmed(&self.window, space.source_penalty);
        let mut engine = Engine {
            bases: &space.bases,
            rules: self.rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        self.window.discard(&mut engine, &targets);
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
        if window.refresh(&mut engine, REFRESHED) && window.snapshots.len() <= REFRESHED {
            window.fit(&mut engine, WINDOW_STEPS);
        }
    }

    /// Searches the window for another number of emitters: begins when it has grown, and goes on with each frame for a share of its time.
    fn revise(&mut self, is_over: &dyn Fn() -> bool) {
        let mut budget = WorkBudget::of_frames(REVISION_WORK, is_over);
        let (space, _, _) = self.single.loaded();
        let mut engine = Engine {
            bases: &space.bases,
            rules: self.rules,
            budget: &mut budget,
            workspace: &mut space.workspace,
        };
        let mut search = WindowSearch {
            engine: &mut engine,
            matched_filter: &mut space.matched_filter,
            penalty: space.source_penalty,
            left: Vec::new(),
        };
        let window = &mut self.window;
        let length = window.snapshots.len();
        self.since_search += 1;
        let mut revision = self.revision.take().filter(|r| r.is_of(window));
        if revision.is_none() {
            let is_due = self.since_search >= SEARCH_AFTER || length as f64 >= SEARCH_GROWTH * self.searched as f64;
            if length < 2 || !is_due {
                return;
            }
            (self.since_search, self.searched) = (0, length);
            let births = search.births(window, &self.left);
            let is_ambiguous = window.is_ambiguous();
            if is_ambiguous || !births.is_empty() {
                revision = Some(Revision::new(window, &search, births, is_ambiguous));
            }
        }
        let Some(mut revision) = revision else { return };
        match revision.advance(&mut search) {
            Revised::Finished => {}
            Revised::Unfinished => self.revision = Some(revision),
            Revised::Better(mut better) => {
                let newer = window.snapshots.iter().filter(|s| s.time_s > revision.time_s());
                let newer: Vec<Snapshot> = newer.cloned().collect();
                better.catch_up(search.engine, &newer, self.memory_s);
                *window = better;
                self.left.clear();
                self.searched = 0;
            }
        }
    }
}
