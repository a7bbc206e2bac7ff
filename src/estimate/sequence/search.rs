//! The number of emitters of a window: births where the residuals of all frames together peak, deaths and merges where the light of a
//! target is no more than noise, and a start from the subspace where frames suffice.

use crate::estimate::detect::matched_filter::MatchedFilter;
use crate::estimate::model::hypothesis::OVERLAPPING;
use crate::estimate::sequence::chances::Chances;
use crate::estimate::sequence::course::open;
use crate::estimate::sequence::joint_information::STATE;
use crate::estimate::sequence::local_quadratic::{Energies, Engine};
use crate::estimate::sequence::residual_map::{ResidualSum, peaks, residual_map};
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::subspace::Subspace;
use crate::estimate::sequence::target::Target;
use crate::estimate::sequence::window::Window;

/// Steps of a fit of the whole window.
pub(crate) const WINDOW_STEPS: usize = 30;
/// Steps of a fit before a hypothesis is compared, and before it is kept.
pub(crate) const TRIAL_STEPS: usize = 40;
pub(crate) const CONVERGE_STEPS: usize = 100;
/// A residual peak is tried from this share of the penalty beyond the noise on: what other emitters have absorbed comes back in the joint fit.
const TRIED: f64 = 0.6;
/// The same where no other emitter is near: what the grid of the matched filter loses.
const TRIED_ALONE: f64 = 0.9;
/// Residual peaks tried in a round.
const PEAKS: usize = 3;
/// Pairs nearer than this many standard deviations of their difference are ambiguous: the window is searched again.
const AMBIGUOUS: f64 = 4.0;
/// Distance, σ, within which who bends their way may be taken for a newcomer: farther, too many of melted scenes lose their velocities,
/// nearer, those who cross are missed.
pub(crate) const BESIDE: f64 = 1.5;
/// Who stands beside a newcomer may have turned in so many frames instead.
pub(crate) const LATELY: f64 = 8.0;
/// Penalty of a change of velocity that explains what a newcomer would: walkers turn every some hundred frames.
pub(crate) const TURN_PENALTY: f64 = 6.0;
/// Rounds of births and deaths.
const ROUNDS: usize = 12;
/// Targets whose removal is tried although nothing speaks against them, those of least light.
const LEAST_LIT: usize = 3;

/// A search of one window.
pub(crate) struct WindowSearch<'s, 'a, 'b> {
    pub engine: &'s mut Engine<'a, 'b>,
    pub matched_filter: &'s mut MatchedFilter,
    pub chances: Chances,
    /// 1 m/s in σ/s.
    pub speed_unit: f64,
    /// What the emitters found last leave; see `residual_map`.
    pub left: Vec<f64>,
}

impl WindowSearch<'_, '_, '_> {
    /// The penalised −2 ln L of a fitted window; the lower, the better. A target pays for the frames that it lights.
    pub fn score(&self, window: &Window) -> f64 {
        let penalties: f64 = self.penalties(window).iter().sum();
        window.cost - window.dropped * window.len() as f64 + penalties
    }

    fn penalties(&self, window: &Window) -> Vec<f64> {
        let targets = window.targets.iter().zip(window.lights());
        targets
            .map(|(t, light)| self.chances.penalty(t.born_s, light.lit))
            .collect()
    }

    /// Places of the maxima of at least `least` of the residual map, the highest first.
    pub fn residual_peaks(&mut self, window: &Window, least: f64) -> Vec<(f64, [f64; 2])> {
        self.left = residual_map(self.engine, self.matched_filter, window);
        on_ground(window, peaks(self.matched_filter, &self.left, least)).collect()
    }

    /// Places where the frames together show light that none shows alone.
    pub fn births(&self, window: &Window, left: &ResidualSum) -> Vec<[f64; 2]> {
        let born_s = window.snapshots.first().map_or(window.time_s, |s| s.time_s);
        if !self.engine.rules.summed_residuals {
            return Vec::new();
        }
        let beyond = |share: f64| self.chances.beyond_noise(born_s, left.frames, window.energies, share);
        let positions = window.positions(self.engine.bases);
        let is_near = |at: [f64; 2]| {
            let mut others = positions.as_slice().chunks_exact(2);
            others.any(|u| (u[0] - at[0]).hypot(u[1] - at[1]) < OVERLAPPING)
        };
        let mut peaks = peaks(self.matched_filter, &left.sum, beyond(TRIED));
        peaks.retain(|(value, at)| is_near(*at) || *value > beyond(TRIED_ALONE));
        on_ground(window, peaks).map(|(_, at)| at).take(PEAKS).collect()
    }

    /// Adds targets at residual peaks while the score improves. Returns whether any was added.
    pub fn grow(&mut self, window: &mut Window, born_s: f64) -> bool {
        let mut has_grown = false;
        for _ in 0..ROUNDS {
            if self.engine.budget.is_exhausted() {
                break;
            }
            let frames = window.snapshots.iter().filter(|s| s.time_s >= born_s).count() as f64;
            let least = self.chances.beyond_noise(born_s, frames, window.energies, TRIED);
            let peaks = self.residual_peaks(window, least);
            let before = self.score(window);
            let mut best: Option<Window> = None;
            for (_, at) in peaks.into_iter().take(PEAKS) {
                let mut next = window.clone();
                next.insert(Target::born(born_s), at, [0.0; 2]);
                let bar = best.as_ref().map_or(before - 1e-6, |b| self.score(b));
                if self.is_below(bar, &mut next) {
                    best = Some(next);
                }
            }
            let Some(best) = best else { break };
            *window = best;
            has_grown = true;
        }
        has_grown
    }

    /// Removes targets while the score improves: those near another, and those of least light.
    pub fn shrink(&mut self, window: &mut Window) -> bool {
        let mut has_shrunk = false;
        while window.len() > 0 && !self.engine.budget.is_exhausted() {
            let before = self.score(window);
            let mut best: Option<Window> = None;
            for e in self.doubtful(window) {
                let mut next = window.clone();
                next.remove(e);
                let bar = best.as_ref().map_or(before, |b| self.score(b));
                if self.is_below(bar, &mut next) {
                    best = Some(next);
                }
            }
            let Some(best) = best else { break };
            *window = best;
            has_shrunk = true;
        }
        has_shrunk
    }

    /// Fits a window, as long as its score may come below `bar`. Whether it does.
    fn is_below(&mut self, bar: f64, window: &mut Window) -> bool {
        window.damping = 0.0;
        let highest = bar - self.score(window) + window.cost;
        window.fit_below(self.engine, &mut { TRIAL_STEPS }, highest);
        self.score(window) < bar
    }

    /// Targets whose light is little against its errors, the weakest first.
    pub fn faint(&self, window: &Window) -> Vec<usize> {
        let (lights, penalties) = (window.lights(), self.penalties(window));
        let mut faint: Vec<usize> = (0..window.len())
            .filter(|&e| lights[e].evidence < 2.0 * penalties[e])
            .collect();
        faint.sort_by(|&a, &b| lights[a].evidence.total_cmp(&lights[b].evidence));
        faint
    }

    /// Targets, the last first, whose light over all frames that held them is less than their penalty: noise that was born as an emitter.
    pub fn unconfirmed(&self, window: &Window) -> Vec<usize> {
        if !self.engine.rules.confirm_newcomers {
            return Vec::new();
        }
        let lights = window.lights();
        let is_noise = |e: &usize| {
            let target = &window.targets[*e];
            let mut light = target.folded;
            light.add(lights[*e]);
            light.evidence < self.chances.penalty(target.born_s, light.lit)
        };
        let present = window.present(window.time_s).into_iter().rev();
        present.filter(is_noise).collect()
    }

    /// Targets that may not be: faint ones, and the farther one of each close pair.
    fn doubtful(&self, window: &Window) -> Vec<usize> {
        let evidence = evidence(window);
        let faint = self.faint(window);
        let place = |e: usize| [window.state[4 * e], window.state[4 * e + 1]];
        let mut doubtful: Vec<usize> = (0..window.len())
            .filter(|&e| {
                let is_near = (0..window.len()).any(|f| {
                    let (a, b) = (place(e), place(f));
                    f != e && (a[0] - b[0]).hypot(a[1] - b[1]) < OVERLAPPING && (evidence[e], e) <= (evidence[f], f)
                });
                is_near || faint.contains(&e)
            })
            .collect();
        doubtful.sort_by(|&a, &b| evidence[a].total_cmp(&evidence[b]));
        doubtful.truncate(4);
        doubtful
    }

    /// Targets whose removal is tried: doubtful ones, and those of least light.
    pub fn weakest(&self, window: &Window) -> Vec<usize> {
        let mut weakest = self.doubtful(window);
        for e in by_light(window).into_iter().take(LEAST_LIT) {
            if !weakest.contains(&e) {
                weakest.push(e);
            }
        }
        weakest
    }

    /// The fitted window with these targets free to have changed their velocity when that explains most: before its frames, or in their middle and,
    /// where they are few, lately. With it, what this takes off the score with the frames before.
    pub fn turned(&self, window: &Window, who: &[usize]) -> (Window, f64) {
        let first_s = window.snapshots.first().map_or(window.time_s, |s| s.time_s);
        let span_s = window.time_s - first_s;
        let spacing_s = span_s / window.snapshots.len().saturating_sub(1).max(1) as f64;
        let middle_s = (0.5 * span_s).max(0.5 * LATELY * spacing_s);
        let [before, amid] = [span_s + spacing_s, middle_s].map(|since_s| self.turned_since(window, who, since_s));
        let (window, folded, _) = if before.2 > amid.2 { before } else { amid };
        (window, folded)
    }

    /// [`Self::turned`] at a time, and with it how much that explains as far as the window is linear.
    fn turned_since(&self, window: &Window, who: &[usize], since_s: f64) -> (Window, f64, f64) {
        let mut window = window.clone();
        let before_s = window.time_s - since_s;
        let older = window.snapshots.iter().take_while(|s| s.time_s < before_s).count();
        let penalties = |window: &Window| self.penalties(window).iter().sum::<f64>();
        let before = penalties(&window);
        let folded = window.fold(older) + before - penalties(&window);
        let explained = open(&mut window.prior, who, since_s, self.speed_unit);
        who.iter().for_each(|&e| window.targets[e].straying.turn());
        let gain = explained + window.decrease();
        (window, folded - explained, gain)
    }

    /// Grows and shrinks until nothing improves.
    pub fn refine(&mut self, window: &mut Window, born_s: f64) {
        for _ in 0..4 {
            let has_grown = self.grow(window, born_s);
            let has_shrunk = self.shrink(window);
            if !has_grown && !has_shrunk {
                break;
            }
        }
    }

    /// The window with emitters from the subspace of its frames alone, not fitted; `None` where they have too many coefficients for that.
    pub fn restarted(&mut self, window: &Window) -> Option<Window> {
        let frames: Vec<_> = window.snapshots.iter().map(|s| &*s.compressed).collect();
        if window.snapshots.iter().any(|s| s.outlook.is_some()) {
            return None;
        }
        let subspace = Subspace::new(&frames)?;
        let first = window.snapshots.first().map_or(0.0, |s| s.time_s);
        let middle = 0.5 * (first + window.time_s);
        let still = Window {
            time_s: middle,
            snapshots: subspace
                .components
                .iter()
                .map(|c| Snapshot::new(middle, c.clone(), None))
                .collect(),
            dropped: subspace.dropped as f64,
            unknown: window.unknown,
            unit_m: window.unit_m,
            energies: Energies::Signed,
            ..Window::default()
        };
        let mut best: Option<Window> = None;
        let peaks = subspace.music(self.engine.bases, subspace.count);
        let current = {
            let positions = window.places(&window.state, middle);
            (0..positions.len() / 2)
                .map(|i| [positions[2 * i], positions[2 * i + 1]])
                .collect()
        };
        for start in [peaks.into_iter().take(subspace.count).collect::<Vec<_>>(), current] {
            let mut next = still.clone();
            for at in start {
                next.insert(Target::born(f64::NEG_INFINITY), at, [0.0; 2]);
            }
            next.fit(self.engine, TRIAL_STEPS);
            self.refine(&mut next, f64::NEG_INFINITY);
            if best.as_ref().is_none_or(|b| self.score(&next) < self.score(b)) {
                best = Some(next);
            }
        }
        let best = best?;
        let mut next = window.clone();
        while next.len() > 0 {
            next.remove(next.len() - 1);
        }
        for at in best.state.as_slice().chunks_exact(STATE) {
            next.insert(Target::born(first), [at[0], at[1]], [0.0; 2]);
        }
        Some(next)
    }
}

/// The places of positions on the newest frame's sensor.
fn on_ground(window: &Window, peaks: Vec<(f64, [f64; 2])>) -> impl Iterator<Item = (f64, [f64; 2])> + use<'_> {
    let newest = window.snapshots.last();
    let place = move |at| newest.map_or(Some(at), |newest| newest.place(at));
    peaks
        .into_iter()
        .filter_map(move |(value, at)| Some((value, place(at)?)))
}

/// What the light of each target weighs against its errors.
fn evidence(window: &Window) -> Vec<f64> {
    window.lights().into_iter().map(|light| light.evidence).collect()
}

/// Targets, those of least light first.
fn by_light(window: &Window) -> Vec<usize> {
    let evidence = evidence(window);
    let mut order: Vec<usize> = (0..window.len()).collect();
    order.sort_by(|&a, &b| evidence[a].total_cmp(&evidence[b]));
    order
}

/// Whether a pair of emitters is not told apart for certain.
pub(crate) fn is_ambiguous(window: &Window) -> bool {
    let Some(covariance) = window.total.covariance() else {
        return true;
    };
    let present = window.present(window.time_s);
    present.iter().any(|&e| {
        present.iter().take_while(|f| **f < e).any(|&f| {
            let d = [0, 1].map(|k| window.state[STATE * e + k] - window.state[STATE * f + k]);
            let of = |a: usize, b: usize| covariance[(a, b)];
            let mut along = 0.0;
            for r in 0..2 {
                for c in 0..2 {
                    let (a, b) = (STATE * e, STATE * f);
                    let s = of(a + r, a + c) + of(b + r, b + c) - of(a + r, b + c) - of(b + r, a + c);
                    along += d[r] * s * d[c];
                }
            }
            let square = d[0] * d[0] + d[1] * d[1];
            square * square < AMBIGUOUS * AMBIGUOUS * along
        })
    })
}
