//! The search of a window for another number of emitters, in shares of a frame's time: one proposal is fitted after another, each as far as the
//! frame's work allows, and goes on with the next frame.

use std::collections::VecDeque;

use crate::estimate::sequence::search::{
    BESIDE, CONVERGE_STEPS, TRIAL_STEPS, TURN_PENALTY, WindowSearch, is_ambiguous,
};
use crate::estimate::sequence::straying::SURPRISE;
use crate::estimate::sequence::target::Target;
use crate::estimate::sequence::window::Window;
use crate::estimate::sequence::window_fit::Progress;

/// A proposal counts as better when it lowers the score by this: what unfinished fits differ by.
const LEAST_GAIN: f64 = 1.0;

/// Another explanation of the window.
enum Proposal {
    /// The same emitters, fitted to the end: what the others are compared with.
    Same,
    Birth([f64; 2]),
    /// In place of a newcomer who would be better than the same emitters: those beside them have turned.
    Turn(Newcomer),
    Death(usize),
    /// What the principal components of all frames show.
    Restart,
}

/// A window with a newcomer, its score, and who stands beside them.
struct Newcomer {
    window: Box<Window>,
    score: f64,
    beside: Vec<usize>,
}

/// A proposal being fitted.
struct Trial {
    proposal: Proposal,
    window: Window,
    steps: usize,
    /// What frames have cost that were folded for a turn.
    folded: f64,
}

impl Trial {
    fn score(&self, search: &WindowSearch) -> f64 {
        search.score(&self.window) + self.folded
    }
}

/// What became of a frame's share of the search.
pub(crate) enum Revised {
    Unfinished,
    /// Nothing is better.
    Finished,
    /// A window that explains the frames better, as of the time when the search began.
    Better(Box<Window>),
}

/// A search in progress.
pub(crate) struct Revision {
    base: Window,
    /// Of the fitted base.
    score: f64,
    proposals: VecDeque<Proposal>,
    trial: Option<Trial>,
}

impl Revision {
    /// Of a window, with an emitter more at one of `births`, without one that may be noise or, where emitters are not told apart for certain, one
    /// of others, or all anew; `None` where there is nothing to try.
    pub fn begin(window: &Window, search: &WindowSearch, births: Vec<[f64; 2]>) -> Option<Self> {
        let mut proposals = VecDeque::from([Proposal::Same]);
        let rules = search.engine.rules;
        proposals.extend(births.into_iter().map(Proposal::Birth));
        let is_ambiguous = is_ambiguous(window);
        if is_ambiguous && rules.principal_components {
            proposals.push_back(Proposal::Restart);
        }
        let without = if is_ambiguous {
            search.weakest(window)
        } else {
            search.faint(window)
        };
        proposals.extend(without.into_iter().map(Proposal::Death));
        (proposals.len() > 1).then(|| Self {
            base: window.clone(),
            score: f64::INFINITY,
            proposals,
            trial: None,
        })
    }

    /// The time as of which the window is searched.
    pub fn time_s(&self) -> f64 {
        self.base.time_s
    }

    /// Whether `window` still follows the emitters that are being searched for, through the frames that are searched.
    pub fn is_of(&self, window: &Window) -> bool {
        let lives = |w: &Window| -> Vec<_> { w.targets.iter().map(|t| (t.born_s, t.died_s)).collect() };
        window.snapshots.iter().any(|s| s.time_s == self.base.time_s) && lives(window) == lives(&self.base)
    }

    /// Goes on until the budget is spent or something is found.
    pub fn advance(&mut self, search: &mut WindowSearch) -> Revised {
        while !search.engine.budget.is_exhausted() {
            let Some(mut trial) = self.trial.take() else {
                let Some(proposal) = self.proposals.pop_front() else {
                    return Revised::Finished;
                };
                self.trial = self.start(search, proposal);
                continue;
            };
            let highest = self.highest(&trial.proposal) - trial.score(search) + trial.window.cost;
            let progress = trial.window.fit_below(search.engine, &mut trial.steps, highest);
            if progress == Progress::Unfinished && trial.steps > 0 {
                self.trial = Some(trial);
                continue;
            }
            if let Some(better) = self.conclude(search, trial) {
                return Revised::Better(Box::new(better));
            }
        }
        Revised::Unfinished
    }

    /// The score below which a proposal is the better explanation.
    fn highest(&self, proposal: &Proposal) -> f64 {
        match proposal {
            Proposal::Turn(newcomer) => newcomer.score - TURN_PENALTY,
            _ => self.score - LEAST_GAIN,
        }
    }

    fn start(&self, search: &mut WindowSearch, proposal: Proposal) -> Option<Trial> {
        let born_s = self.base.snapshots.first().map_or(self.base.time_s, |s| s.time_s);
        let mut window = self.base.clone();
        let mut steps = TRIAL_STEPS;
        let mut folded = 0.0;
        match &proposal {
            Proposal::Same => {}
            Proposal::Birth(at) => window.insert(Target::born(born_s), *at, [0.0; 2]),
            Proposal::Turn(newcomer) => (window, folded) = search.turned(&window, &newcomer.beside),
            Proposal::Death(e) => window.remove(*e),
            Proposal::Restart => {
                window = search.restarted(&window)?;
                steps = CONVERGE_STEPS;
            }
        }
        window.damping = 0.0;
        Some(Trial {
            proposal,
            window,
            steps,
            folded,
        })
    }

    /// Compares a fitted trial. Returns the better window, where there is one.
    fn conclude(&mut self, search: &mut WindowSearch, trial: Trial) -> Option<Window> {
        let score = trial.score(search);
        let is_better = score < self.highest(&trial.proposal);
        let Trial { proposal, window, .. } = trial;
        match proposal {
            Proposal::Same => {
                (self.score, self.base) = (score, window);
                None
            }
            Proposal::Birth(_) if is_better && search.engine.rules.turns_before_newcomers => {
                let mut beside = window.beside(&[window.place(self.base.len())], BESIDE);
                beside.retain(|e| *e < self.base.len());
                if beside.is_empty() {
                    return Some(window);
                }
                self.proposals.push_front(Proposal::Turn(Newcomer {
                    window: Box::new(window),
                    score,
                    beside,
                }));
                None
            }
            Proposal::Turn(newcomer) if !is_better => Some(*newcomer.window),
            Proposal::Turn(_) => (score + SURPRISE < self.score).then_some(window),
            _ => is_better.then_some(window),
        }
    }
}
