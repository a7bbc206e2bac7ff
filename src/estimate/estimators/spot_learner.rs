//! When the spot's shape is learned from the frames that are searched, and while what was learned is used.

use std::sync::Arc;

use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::frame_search::{Found, FrameSearch, SearchKind};
use crate::estimate::fit::source_groups::merged;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model_order::bright_spots::CORE;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::learned_spot::LearnedSpot;
use crate::estimate::model_order::spot_error::with_known_width;
use crate::optics::{Camera, SpotError};

/// Pixel pitch, σ, from which on pixels do not tell a spot's shape.
const COARSEST: f64 = 2.0;
/// Most alternations of learning the shape and fitting the sources, and the excess of one over the last's from which on they end.
const MOST_PASSES: usize = 8;
const STALLED: f64 = 0.9;
/// Excess up to which a shape explains a frame, as what was learned from others is not exact, and up to which share of the excess without it, as the
/// tails of bright spots are not learned in full.
const EXPLAINED: f64 = 5.0;
const MOST_LEFT: f64 = 0.002;
/// Share of the excess that a shape must do away with to be used first.
const LEAST_GAIN: f64 = 0.5;
/// Sources for each that may stand in the spots' halo unseen, as somebody who was there before the halo was known.
const FOR_ONE_UNSEEN: usize = 3;
/// Fewest groups of sources that may be the spots of another shape, and their sources in the mean: a crowd is not round everywhere, and pairs are users.
const LEAST_GROUPS: usize = 3;
const CROWDED: usize = 3;
/// One frame in so many is learned from at least.
const ONE_IN: u32 = 16;
/// Most frames until the next try, which are doubled by each that failed.
const LONGEST_REST: u32 = 128;

/// The spot's shape as frames show it.
pub(crate) struct SpotLearner {
    /// A camera whose spot nobody has measured.
    camera: Camera,
    learned: Option<Learned>,
    misfit: Misfit,
    /// Frames since the shape that is used was learned first.
    frames: u32,
    /// Frames one after another that show more than was learned.
    misfits: u32,
    /// Tries that failed one after another, and frames until the next.
    failed: u32,
    rest: u32,
}

/// A shape that explains frames.
struct Learned {
    spot: LearnedSpot,
    camera: Camera,
    excess: f64,
}

/// What the first frame showed without a learned shape, and what frames since left with it.
#[derive(Default)]
struct Misfit {
    spot_error: f64,
    before: f64,
    left: f64,
    frames: f64,
}

impl Misfit {
    /// The spot error that is left: a misfit's deviance grows with its square.
    fn rest(&self) -> f64 {
        let left = self.left / self.frames + 1.0 / self.frames.sqrt();
        self.spot_error * (left.max(0.0) / self.before).sqrt().min(1.0)
    }
}

/// What a frame says of the shape that it was searched with.
pub(crate) enum Lesson {
    Nothing,
    /// To be searched again for spots of this camera.
    Better(Box<Camera>),
    /// What was learned does not explain it: to be searched for the spots of this camera, as it was configured.
    Wrong(Box<Camera>),
}

impl SpotLearner {
    pub fn new(camera: &Camera) -> Option<Self> {
        let is_unknown = camera.spot_shape.is_none() && !camera.spot_error.is_fixed();
        let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
        (is_unknown && pitch < COARSEST * camera.spot_sigma_m).then(|| Self {
            camera: camera.clone(),
            learned: None,
            misfit: Misfit::default(),
            frames: 0,
            misfits: 0,
            failed: 0,
            rest: 0,
        })
    }

    /// Takes a camera as configured, whose spot is of another width.
    pub fn configure(&mut self, camera: &Camera) {
        self.camera = camera.clone();
    }

    /// Learns from a frame that was searched.
    pub fn learn(&mut self, search: &mut FrameSearch, found: &Found, budgets: &mut Budgets) -> Lesson {
        if found.hypothesis.sources.is_empty() {
            return Lesson::Nothing;
        }
        let groups = groups_as_spots(&found.hypothesis);
        let is_shown = found.spot_error > search.least_spot_error();
        if self.learned.is_none() {
            self.rest = self.rest.saturating_sub(1);
            // What uneven light along a smear may be hides a misfit of the shape.
            let is_hidden = search.compressed.unevenness > 0.0;
            let is_misfit = is_shown && search.shown_by_recent_frames().is_some() || groups.is_some() || is_hidden;
            if !is_misfit || self.rest > 0 {
                return Lesson::Nothing;
            }
            (self.frames, self.misfits) = (0, 0);
        }
        self.frames += 1;
        self.misfits = if is_shown || groups.is_some() {
            self.misfits + 1
        } else {
            0
        };
        let is_due =
            self.misfits.is_power_of_two() || self.frames.is_power_of_two() || self.frames.is_multiple_of(ONE_IN);
        if !is_due {
            return Lesson::Nothing;
        }
        budgets.search.restart();
        let was_used = self.learned.is_some();
        self.learned = groups
            .and_then(|spots| self.of_groups(&spots, search, budgets))
            .or_else(|| self.of_sources(search, found, budgets));
        let Some(learned) = &mut self.learned else {
            self.failed += 1;
            self.rest = LONGEST_REST.min(1 << self.failed.min(8) >> 1);
            return match was_used {
                true => Lesson::Wrong(Box::new(self.camera.clone())),
                false => Lesson::Nothing,
            };
        };
        if self.frames.is_multiple_of(ONE_IN) {
            self.failed = 0;
        }
        self.misfit.left += learned.excess;
        self.misfit.frames += 1.0;
        let error = learned.camera.spot_error.least().max(self.misfit.rest());
        learned.camera.spot_error = SpotError::AtLeast(error);
        Lesson::Better(Box::new(learned.camera.clone()))
    }

    /// The shape of which groups of sources are single spots.
    fn of_groups(&mut self, spots: &Hypothesis, search: &FrameSearch, budgets: &mut Budgets) -> Option<Learned> {
        let anew = LearnedSpot::new(&search.reweighting.space.bases);
        let learned = self.fitted(&anew, search, spots, budgets)?;
        (learned.excess < EXPLAINED).then(|| {
            self.misfit = Misfit::default();
            learned
        })
    }

    /// The shape of a frame's sources: refined where one is known and explains it.
    fn of_sources(&mut self, search: &mut FrameSearch, found: &Found, budgets: &mut Budgets) -> Option<Learned> {
        let hypothesis = with_known_width(&found.hypothesis);
        let before = excess_with(search, &mut Candidate::from(hypothesis.clone()), budgets);
        let most = EXPLAINED.max(MOST_LEFT * before);
        if let Some(known) = self.learned.take() {
            let refined = self.fitted(&known.spot, search, &hypothesis, budgets);
            let refined = refined.filter(|learned| learned.excess < most);
            if refined.is_some() {
                return refined;
            }
        } else if before < search.compressed.most_excess() {
            return None;
        }
        self.misfit = Misfit {
            spot_error: found.spot_error,
            before,
            ..Misfit::default()
        };
        let anew = LearnedSpot::new(&search.reweighting.space.bases);
        let learned = self.fitted(&anew, search, &hypothesis, budgets)?;
        (learned.excess < most.min(LEAST_GAIN * before)).then_some(learned)
    }

    /// Alternates the shape, from what was known and the frame, with the places and energies of sources.
    fn fitted(
        &self,
        known: &LearnedSpot,
        search: &FrameSearch,
        start: &Hypothesis,
        budgets: &mut Budgets,
    ) -> Option<Learned> {
        let mut candidate = Candidate::from(start.clone());
        let mut best: Option<Learned> = None;
        let mut at = known.clone();
        let mut are_unseen_added = false;
        for _ in 0..MOST_PASSES {
            let mut spot = known.at(&at);
            let smear = search.compressed.smear.as_ref();
            spot.add(
                &search.reweighting.space.bases,
                &search.frame,
                smear,
                &candidate.sources,
            );
            let (shape, error) = spot.shape(&self.camera)?;
            let camera = Camera {
                spot_shape: Some(Arc::new(shape)),
                spot_error: SpotError::AtLeast(error.max(self.camera.spot_error.least())),
                ..self.camera.clone()
            };
            let mut shaped = search.of_shape(&camera);
            let excess = excess_with(&mut shaped, &mut candidate, budgets);
            let is_explained = excess < shaped.compressed.most_excess();
            let last = best.as_ref().map_or(f64::INFINITY, |best| best.excess);
            at = spot.clone();
            if excess < last && (is_explained || !are_unseen_added) {
                best = Some(Learned { spot, camera, excess });
            }
            if is_explained || budgets.search.is_exhausted() {
                break;
            }
            if excess > STALLED * last {
                if are_unseen_added || !add_unseen(&mut shaped, &mut candidate, budgets) {
                    break;
                }
                are_unseen_added = true;
            }
        }
        best
    }
}

/// Each group of close sources as one, where these groups are few enough to be the spots of another shape.
fn groups_as_spots(hypothesis: &Hypothesis) -> Option<Hypothesis> {
    let spots = merged(&hypothesis.sources, CORE);
    let are_crowded = spots.len() >= LEAST_GROUPS && CROWDED * spots.len() <= hypothesis.sources.len();
    are_crowded.then(|| Hypothesis {
        sources: spots,
        ..with_known_width(hypothesis)
    })
}

/// The excess of a hypothesis that is fitted in the main space of a search.
fn excess_with(search: &mut FrameSearch, candidate: &mut Candidate, budgets: &mut Budgets) -> f64 {
    candidate.converged = false;
    let mut fit = search.again(SearchKind::Main, budgets);
    fit.fit_trial(candidate);
    fit.compressed().excess(candidate)
}

/// Adds the strongest peaks of what a hypothesis leaves, a few for so many sources. Returns whether there are any.
fn add_unseen(search: &mut FrameSearch, candidate: &mut Candidate, budgets: &mut Budgets) -> bool {
    let most = candidate.sources.len() / FOR_ONE_UNSEEN;
    let peaks = search.again(SearchKind::Main, budgets).residual_peaks(candidate);
    let unseen = peaks.iter().take(most).map(|peak| PointSource::new(peak.u, peak.a));
    let before = candidate.sources.len();
    candidate.sources.extend(unseen);
    candidate.sources.len() > before
}
