//! What a frame's search makes of a lens whose spots differ from the PSF: from the frame alone, and from what recent frames showed.

use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::frame_search::{Found, FrameSearch, SearchKind};
use crate::estimate::estimators::search_bases::bases;
use crate::estimate::model::hypothesis::{Hypothesis, Width};
use crate::estimate::model_order::bright_spots::bright_spots;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::initialise::initial_hypothesis;
use crate::estimate::model_order::nuisance_selection::{EARLY_ROUNDS, ROUNDS};
use crate::estimate::model_order::refine::refine;
use crate::estimate::model_order::reweighting::Reweighting;
use crate::estimate::model_order::spot_error::{
    Shape, drop_halo, inspect_shape, keep_weighted, load_weighted, search_with_spot_error, shown_spot_error,
    try_spot_error, without_halo_of,
};
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::optics::{Camera, SpotError};

/// Share of a frame's work for a try with the ellipse that recent frames showed: spots that overlap are split one after another.
const USUAL_ELLIPSE_WORK: f64 = 0.4;

impl FrameSearch {
    /// A search of the same frame for the spots of another shape.
    pub fn of_shape(&self, camera: &Camera) -> Self {
        let mut search = Self::new(self.spec, camera, self.space.rules, bases(camera));
        search.take_frame(self.frame.clone(), camera);
        search
    }

    /// Takes a frame that another search was loaded with.
    pub fn take_frame(&mut self, frame: PreprocessedFrame, camera: &Camera) {
        self.frame = frame;
        self.inspect(camera.quantum());
    }

    /// The emitters as elongated as recent frames showed, if that explains a frame which round ones do not. Not where spots melt: there
    /// emitters explain an ellipse, and an ellipse emitters.
    pub fn find_with_usual_ellipse(&mut self, budgets: &mut Budgets) -> Option<Found> {
        let [x, y, covariance_xy] = self.ellipse.usual().filter(|_| self.space.rules.remember_ellipse)?;
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budgets.search);
        if search.pencil.is_some() {
            return None;
        }
        let limit = search.context.budget.limit(USUAL_ELLIPSE_WORK);
        let mut candidate = Candidate::from(initial_hypothesis(&mut search));
        let is_round = search.is_explained_by(&candidate);
        if !is_round {
            candidate.width = [x, y];
            candidate.covariance_xy = covariance_xy;
            search.fit_trial(&mut candidate);
            refine(&mut search, &mut candidate, ROUNDS);
            candidate.nuisances = search.with_background(Width::RotatedEllipse);
            search.fit_trial(&mut candidate);
            refine(&mut search, &mut candidate, EARLY_ROUNDS);
            search.converge(&mut candidate);
        }
        let is_elongated = !is_round && search.is_explained_by(&candidate);
        search.context.budget.restore_limit(limit);
        if !is_elongated {
            return None;
        }
        let hypothesis = candidate.into_hypothesis();
        self.ellipse.push(&hypothesis);
        self.history.iter_mut().for_each(|history| history.push(0.0));
        Some(Found::of(hypothesis, SearchKind::Main))
    }

    /// Where the spots differ from the PSF, searches again with that allowed for. Returns whether fewer sources explain the frame under equal
    /// weights.
    pub fn allow_for_shape(&mut self, found: &mut Found, budgets: &mut Budgets) -> bool {
        if !self.spec.chooses_order() {
            let error = self.least_spot_error();
            if error > 0.0 {
                drop_halo(
                    &self.space.bases,
                    error,
                    self.space.source_penalty,
                    &mut found.hypothesis.sources,
                );
                found.spot_error = error;
            }
            return false;
        }
        let known = self.least_spot_error();
        if known > 0.0 {
            let Reweighting { space, compressed } = &mut self.reweighting;
            let (frame, budget) = (&self.frame, &mut budgets.reweighting);
            let start = without_halo_of(&frame.beyond, &found.hypothesis);
            found.hypothesis = search_with_spot_error(space, compressed, frame, known, start, budget);
            found.spot_error = known;
            found.kind = SearchKind::Reweighted;
        }
        if self.spot_error.is_fixed() {
            return false;
        }
        let compressed = self.compressed_of(found.kind);
        let is_explained = compressed.is_explained_by(&found.hypothesis);
        let excess = compressed.excess(&found.hypothesis);
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        match inspect_shape(space, compressed, frame, &found.hypothesis, excess, budget) {
            Shape::Simpler(simpler) if known == 0.0 => {
                found.hypothesis = simpler;
                return true;
            }
            Shape::Different(error, bright) if error > known => {
                let next = search_with_spot_error(space, compressed, frame, error, bright, budget);
                let is_simpler =
                    next.sources.len() < found.hypothesis.sources.len() && compressed.is_explained_by(&next);
                if !is_explained || is_simpler {
                    found.hypothesis = next;
                    found.spot_error = error;
                    return false;
                }
            }
            _ => {}
        }
        if known > 0.0 {
            keep_weighted(space, compressed, frame, known, &found.hypothesis);
        }
        false
    }

    /// The emitters under the spot error that recent frames showed, and whether this frame shows one around them.
    pub fn find_as_remembered(&mut self, error: f64, budgets: &mut Budgets) -> (Found, bool) {
        let known = std::mem::replace(&mut self.spot_error, SpotError::Fixed(error));
        let mut found = self.find(budgets);
        self.allow_for_shape(&mut found, budgets);
        self.spot_error = known;
        found.kind = SearchKind::Reweighted;
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        let shown = shown_spot_error(space, compressed, frame, &found.hypothesis, false, budget);
        let is_shown = shown > known.least();
        if is_shown {
            self.history.iter_mut().for_each(|history| history.push(shown));
            load_weighted(space, compressed, frame, error, &found.hypothesis);
        }
        (found, is_shown)
    }

    /// Takes the emitters under the remembered spot error where more are needed without it.
    pub fn keep_fewer(&mut self, found: &mut Found, remembered: Found) {
        if remembered.hypothesis.sources.len() < found.hypothesis.sources.len() {
            let Reweighting { space, compressed } = &mut self.reweighting;
            let error = remembered.spot_error;
            load_weighted(space, compressed, &self.frame, error, &remembered.hypothesis);
            *found = remembered;
        }
    }

    /// Adds what the frame's bright spots leave to what recent frames left.
    pub fn stack_misfit(&mut self, hypothesis: &Hypothesis, budgets: &mut Budgets) {
        let Some(history) = self.history.as_mut().filter(|_| !hypothesis.sources.is_empty()) else {
            return;
        };
        if !history.stacked.is_due() || budgets.search.is_exhausted() {
            return;
        }
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budgets.search);
        let mut candidate = Candidate::from(Hypothesis {
            sources: bright_spots(hypothesis, false),
            converged: false,
            ..hypothesis.clone()
        });
        search.fit_trial(&mut candidate);
        history.stacked.add(&mut search, &mut candidate);
    }

    /// The spot error that recent frames showed, where it is more than what is known of the lens.
    pub fn shown_by_recent_frames(&self) -> Option<f64> {
        let shown = self.history.as_ref()?.spot_error()?;
        (shown > self.least_spot_error()).then_some(shown)
    }

    /// Remembers the spot error that the frame shows. Where emitters explain the frame and a lens does as well, the frames decide.
    pub fn remember_shape(&mut self, found: &mut Found, budgets: &mut Budgets) {
        let is_explained = self.compressed_of(found.kind).is_explained_by(&found.hypothesis);
        let known = self.least_spot_error();
        let Some(history) = self.history.as_mut().filter(|_| !found.hypothesis.sources.is_empty()) else {
            return;
        };
        if found.spot_error > known || !is_explained {
            let shown = Some(found.spot_error).filter(|error| *error > known);
            history.push(shown.unwrap_or_default());
            return;
        }
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        let lens = try_spot_error(space, compressed, frame, &found.hypothesis, budget);
        let lens = lens.filter(|(error, _)| *error > known);
        history.push(lens.as_ref().map_or(0.0, |(error, _)| *error));
        if let (Some(error), Some((_, bright))) = (history.spot_error().filter(|error| *error > known), lens) {
            found.hypothesis = search_with_spot_error(space, compressed, frame, error, bright, budget);
            found.spot_error = error;
        } else if known > 0.0 {
            keep_weighted(space, compressed, frame, known, &found.hypothesis);
        }
    }
}
