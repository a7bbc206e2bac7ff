//! The estimator `sequence`: what happens with a frame.

use std::sync::Arc;

use jiff::Timestamp;
use nalgebra::DVector;

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::EstimatorSpec;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::rules::Rules;
use crate::estimate::sequence::chances::Chances;
use crate::estimate::sequence::course::open;
use crate::estimate::sequence::joint_information::JointInformation;
use crate::estimate::sequence::local_quadratic::Engine;
use crate::estimate::sequence::motion::surprised;
use crate::estimate::sequence::outlook::Outlook;
use crate::estimate::sequence::report::report;
use crate::estimate::sequence::residual_map::ResidualSum;
use crate::estimate::sequence::revision_schedule::{RevisionSchedule, YOUNG};
use crate::estimate::sequence::search::{BESIDE, LATELY, TURN_PENALTY, WINDOW_STEPS, WindowSearch};
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::spot_width::learn_width;
use crate::estimate::sequence::straying::SURPRISE;
use crate::estimate::sequence::target::Target;
use crate::estimate::sequence::upkeep::{MAX_SNAPSHOTS, bury, most_snapshots, refresh};
use crate::estimate::sequence::window::Window;
use crate::frame::Frame;
use crate::geo::Sight;
use crate::optics::{Camera, Smear};

/// Steps of a fit to a new frame.
const FRAME_STEPS: usize = 12;
/// Emitters of which a moving platform's pose explains all: their six numbers are its own.
const EXPLAINED_BY_POSE: usize = 3;
/// Work of a search that has to end with its frame, in frames' searches: where what is remembered explains nothing.
const SEARCH_WORK: f64 = 0.5;

/// An estimator that remembers.
pub(crate) struct SequenceEstimator {
    spec: &'static EstimatorSpec,
    single: AnalyticEstimator,
    camera: Arc<Camera>,
    rules: Rules,
    /// Of a moving platform, in the next frame; and what that frame sees where.
    sight: Option<Sight>,
    outlook: Option<Arc<Outlook>>,
    /// Times are seconds since this.
    epoch: Option<Timestamp>,
    window: Window,
    /// What frames have left unexplained since the number of emitters changed.
    left: ResidualSum,
    schedule: RevisionSchedule,
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
            camera: Arc::new(camera.clone()),
            rules,
            sight: None,
            outlook: None,
            epoch: None,
            window: Window::default(),
            left: ResidualSum::default(),
            schedule: RevisionSchedule::default(),
            memory_s,
        }
    }

    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Goes on with spots of this width, m.
    pub fn take_width(&mut self, sigma_m: f64) {
        self.single.take_width(sigma_m);
        self.begin_anew();
    }

    /// With spots of another width everything is seen anew.
    fn begin_anew(&mut self) {
        self.camera = Arc::new(self.single.camera().clone());
        self.forget();
    }

    fn forget(&mut self) {
        let scale = self.sight.as_ref().map(|sight| sight.ground_scale(&self.camera));
        self.window = Window::empty(&self.camera, scale.unwrap_or(self.camera.ground_scale()));
        self.left.clear();
        self.schedule = RevisionSchedule::default();
    }
}

impl Estimator for SequenceEstimator {
    fn name(&self) -> &'static str {
        self.spec.name
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.single.set_smear(smear);
    }

    fn set_sight(&mut self, sight: Option<&Sight>) {
        self.sight = sight.cloned();
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let scale = self.single.load(frame)?;
        let epoch = *self.epoch.get_or_insert(frame.time);
        let time_s = frame.time.duration_since(epoch).as_secs_f64();
        let elapsed = time_s - self.window.time_s;
        let goes_on = elapsed > 0.0 && elapsed <= self.memory_s && self.outlook.is_some() == self.sight.is_some();
        if self.window.age == 0 || !goes_on {
            self.forget();
            self.window.time_s = time_s;
        }
        let (camera, unit_m) = (&self.camera, self.window.unit_m);
        self.outlook = (self.sight.as_ref()).map(|sight| Arc::new(Outlook::new(sight, camera, unit_m)));
        self.window.advance(time_s, self.memory_s);
        if !self.rules.follow_accelerations {
            self.window.targets.iter_mut().for_each(|t| t.straying.go_straight());
        }
        self.window.keep_straight(time_s);
        let estimate = match self.take(time_s, elapsed, scale, is_over) {
            Some(alone) => alone,
            None => {
                self.tend(elapsed, is_over);
                self.revise(is_over);
                let (window, camera, name) = (&self.window, &self.camera, self.spec.name);
                report(&mut self.single, window, camera, self.rules, name, scale, is_over)
            }
        };
        if learn_width(&mut self.single, &estimate, is_over) {
            self.begin_anew();
        }
        Ok(estimate)
    }
}

impl SequenceEstimator {
    /// Takes the loaded frame into the window. Where the model explains it in no way, what it shows alone is returned, and what is
    /// remembered stays as it is.
    fn take(&mut self, time_s: f64, elapsed: f64, scale: f64, is_over: &dyn Fn() -> bool) -> Option<Estimate> {
        let mut budget = WorkBudget::new(is_over);
        let (_, compressed, frame) = self.single.loaded();
        let is_even = frame.variance.is_constant() && compressed.unevenness == 0.0 && !frame.is_clipped();
        let is_told = self.outlook.is_none() || self.window.present(time_s).len() > EXPLAINED_BY_POSE;
        if is_even && is_told && self.window.len() > 0 {
            let known = self.window.total.clone();
            let fresh = self.fresh(known.clone(), time_s);
            let mut fresh = self.fit(fresh, &mut budget);
            let turned = surprised(&known, &mut fresh, 1.0 / self.window.unit_m);
            if turned.is_empty()
                && let Some(grown) = self.explain(fresh.clone(), scale, &mut budget)
            {
                self.accept_turned(fresh, grown, &[], elapsed, &mut budget);
                return None;
            }
            // The first frames may have been misread; later it is likelier that somebody has turned or stopped: the same with a manoeuvre since
            // the frame before.
            let is_young = self.window.age <= YOUNG;
            if turned.is_empty() && is_young && self.search_again(time_s, is_over) {
                return None;
            }
            if !turned.is_empty() {
                let fresh = self.turned(&turned, 0.5 * elapsed, &mut budget);
                if let Some(grown) = self.explain(fresh.clone(), scale, &mut budget) {
                    self.accept_turned(fresh, grown, &turned, elapsed, &mut budget);
                    return None;
                }
            }
        }
        if is_even && is_told && self.window.age > YOUNG && self.search_again(time_s, is_over) {
            return None;
        }
        // What is remembered is wrong where this frame alone is explained and its prediction is not.
        let found = self.single.estimate_loaded(scale, is_over);
        if is_even && self.outlook.is_some() && found.emitters.len() <= EXPLAINED_BY_POSE {
            self.forget();
            return Some(found);
        }
        let mut alone = Window {
            targets: Vec::new(),
            state: DVector::zeros(0),
            ..self.fresh(JointInformation::default(), time_s)
        };
        for emitter in &found.emitters {
            let position = emitter.sensor_m.map(|v| v / self.camera.spot_sigma_m);
            if let Some(place) = alone.snapshots[0].place(position) {
                alone.insert(Target::born(time_s), place, [0.0; 2]);
            }
        }
        let fitted = if is_even {
            let alone = self.fit(alone, &mut budget);
            self.with_newcomers(alone, &mut budget)
        } else {
            None
        };
        let Some(alone) = fitted else { return Some(found) };
        if self.window.len() > 0 {
            self.forget();
            self.window.time_s = time_s;
        }
        self.window.take(alone);
        None
    }

    /// The fitted newest frame with newcomers; `None` where that does not explain it. They need the frame's own word: where it shows alone no
    /// fewer emitters than are known, but fewer than with them, there are none.
    fn explain(&mut self, fresh: Window, scale: f64, budget: &mut WorkBudget) -> Option<Window> {
        let before = fresh.present(fresh.time_s).len();
        let grown = self.with_newcomers(fresh.clone(), budget)?;
        let after = grown.present(grown.time_s).len();
        if after == before || !self.rules.ask_frame_alone {
            return Some(grown);
        }
        let found = self.single.estimate_loaded(scale, &|| budget.is_exhausted());
        let has_newcomers = !(before..after).contains(&found.emitters.len());
        let fresh = if has_newcomers { grown } else { fresh };
        fresh.is_last_explained().then_some(fresh)
    }

    /// The newest frame fitted to what is remembered, where these targets may have changed their velocity `since_s` seconds ago.
    fn turned(&mut self, who: &[usize], since_s: f64, budget: &mut WorkBudget) -> Window {
        let mut opened = self.window.total.clone();
        open(&mut opened, who, since_s, 1.0 / self.window.unit_m);
        let mut fresh = self.fresh(opened, self.window.time_s);
        who.iter().for_each(|&e| fresh.targets[e].straying.turn());
        self.fit(fresh, budget)
    }

    /// Makes the newest frame, fitted and `grown` by newcomers, part of the window, in which these targets may have changed their velocity
    /// since the frame before. Newcomers beside others have to explain it better than that these have turned.
    fn accept_turned(
        &mut self,
        fresh: Window,
        mut grown: Window,
        who: &[usize],
        elapsed: f64,
        budget: &mut WorkBudget,
    ) {
        let (mut who, mut since_s) = (who.to_vec(), 0.5 * elapsed);
        let newcomers: Vec<[f64; 2]> = (self.window.len()..grown.len()).map(|e| grown.place(e)).collect();
        let mut doubted = fresh.beside(&newcomers, BESIDE);
        doubted.retain(|e| !who.contains(e));
        if !doubted.is_empty() && self.rules.turns_before_newcomers {
            doubted.extend(&who);
            let lately = 0.5 * LATELY * elapsed;
            let turned = self.turned(&doubted, lately, budget);
            let [as_is, with_newcomers, with_turn] =
                self.with_search(budget, |_, search| [&fresh, &grown, &turned].map(|w| search.score(w)));
            let can_stay = fresh.is_last_explained() && as_is < with_turn + SURPRISE;
            if with_turn + TURN_PENALTY < with_newcomers {
                if can_stay {
                    grown = fresh;
                } else if turned.is_last_explained() {
                    (grown, who, since_s) = (turned, doubted, lately);
                }
            }
        }
        if !who.is_empty() {
            let (all, unit) = (self.window.snapshots.len(), 1.0 / self.window.unit_m);
            self.window.fold(all);
            open(&mut self.window.prior, &who, since_s, unit);
            self.left.clear();
        }
        self.window.take(grown);
    }

    /// Searches the frames of the window together with the loaded one, as what is remembered may be wrong. Whether that explains it.
    fn search_again(&mut self, time_s: f64, is_over: &dyn Fn() -> bool) -> bool {
        let Some(first) = self.window.snapshots.first().filter(|_| self.rules.search_again) else {
            return false;
        };
        let born_s = first.time_s;
        let mut next = self.window.clone();
        next.snapshots
            .append(&mut self.fresh(JointInformation::default(), time_s).snapshots);
        let mut budget = WorkBudget::of_frames(SEARCH_WORK, is_over);
        self.with_search(&mut budget, |_, search| {
            next.fit(search.engine, WINDOW_STEPS);
            search.refine(&mut next, born_s);
        });
        let is_explained = next.is_last_explained();
        if is_explained {
            self.window = next;
        }
        is_explained
    }

    /// A window of the loaded frame alone, on top of `prior`.
    fn fresh(&mut self, prior: JointInformation, time_s: f64) -> Window {
        let (targets, state) = (self.window.targets.clone(), self.window.state.clone());
        let (unknown, unit_m) = (self.window.unknown, self.window.unit_m);
        let outlook = self.outlook.clone();
        let mut snapshot = Snapshot::new(time_s, Arc::new(self.single.loaded().1.clone()), outlook);
        snapshot.local.pose_error = self.window.pose_error;
        Window {
            targets,
            time_s,
            state,
            prior,
            unknown,
            unit_m,
            snapshots: vec![snapshot],
            ..Window::default()
        }
    }

    /// Fits the newest frame to what is remembered.
    fn fit(&mut self, mut fresh: Window, budget: &mut WorkBudget) -> Window {
        self.with_search(budget, |_, search| fresh.fit(search.engine, FRAME_STEPS));
        fresh
    }

    /// The fitted newest frame with all newcomers that it shows; `None` where that does not explain it.
    fn with_newcomers(&mut self, mut fresh: Window, budget: &mut WorkBudget) -> Option<Window> {
        let time_s = fresh.time_s;
        let (has_grown, left) = self.with_search(budget, |_, search| {
            let has_grown = search.grow(&mut fresh, time_s);
            (has_grown, std::mem::take(&mut search.left))
        });
        let is_explained = fresh.is_last_explained();
        if has_grown {
            self.left.clear();
        } else if is_explained {
            let filter = &self.single.loaded().0.matched_filter;
            self.left.add(filter, &left, self.outlook.clone(), MAX_SNAPSHOTS as f64);
        }
        is_explained.then_some(fresh)
    }

    /// Ends targets that are gone, forgets newcomers that were noise, and keeps the window within its bounds and linearised.
    fn tend(&mut self, elapsed: f64, is_over: &dyn Fn() -> bool) {
        let (_, compressed, _) = self.single.loaded();
        let most = most_snapshots(compressed.mx * compressed.my);
        let mut budget = WorkBudget::new(is_over);
        self.with_search(&mut budget, |window, search| {
            bury(window, search.engine, elapsed);
            let noise = search.unconfirmed(window);
            window.discard(search.engine, &noise);
        });
        let mut budget = WorkBudget::of_frames(SEARCH_WORK, is_over);
        self.with_search(&mut budget, |window, search| refresh(window, search.engine, most));
    }

    /// Searches the window for another number of emitters: begins when it has grown, and goes on with each frame for a share of its time.
    fn revise(&mut self, is_over: &dyn Fn() -> bool) {
        if !self.schedule.is_due(&self.window) {
            return;
        }
        let (mut schedule, left) = (std::mem::take(&mut self.schedule), std::mem::take(&mut self.left));
        let memory_s = self.memory_s;
        let mut budget = WorkBudget::of_frames(RevisionSchedule::work(&self.window), is_over);
        let has_changed = self.with_search(&mut budget, |window, search| {
            schedule.advance(window, search, &left, memory_s)
        });
        self.schedule = schedule;
        if !has_changed {
            self.left = left;
        }
    }

    /// Runs `run` on the window, with what a search of the loaded frame's space needs.
    fn with_search<R>(&mut self, budget: &mut WorkBudget, run: impl FnOnce(&mut Window, &mut WindowSearch) -> R) -> R {
        let speed_unit = 1.0 / self.window.unit_m;
        let (space, _, _) = self.single.loaded();
        let mut engine = Engine {
            bases: &space.bases,
            rules: self.rules,
            budget,
            workspace: &mut space.workspace,
        };
        let mut search = WindowSearch {
            engine: &mut engine,
            matched_filter: &mut space.matched_filter,
            chances: Chances::new(&self.window, space.source_penalty),
            speed_unit,
            left: Vec::new(),
        };
        run(&mut self.window, &mut search)
    }
}
