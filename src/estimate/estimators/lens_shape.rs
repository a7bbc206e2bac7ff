//! What a frame's search makes of a lens whose spots differ from the PSF: from the frame alone, and from what recent frames showed.

use crate::estimate::estimators::budgets::Budgets;
use crate::estimate::estimators::frame_search::{Found, FrameSearch, SearchKind};
use crate::estimate::model_order::reweighting::Reweighting;
use crate::estimate::model_order::spot_error::{
    Shape, drop_halo, inspect_shape, load_weighted, search_with_spot_error, shown_spot_error, try_spot_error,
};

impl FrameSearch {
    /// Where the spots differ from the PSF, searches again with that allowed for. Returns whether fewer sources explain the frame under equal
    /// weights.
    pub fn allow_for_shape(&mut self, found: &mut Found, budgets: &mut Budgets) -> bool {
        if !self.spec.chooses_order() {
            if let Some(error) = self.spot_error.filter(|e| *e > 0.0) {
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
        let compressed = self.compressed_of(found.kind);
        let is_explained = compressed.is_explained_by(&found.hypothesis);
        let excess = compressed.excess(&found.hypothesis);
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        let shape = match self.spot_error {
            Some(0.0) => Shape::AsModelled,
            Some(error) => Shape::of_spot_error(error, &found.hypothesis, &self.frame.beyond),
            None => inspect_shape(space, compressed, frame, &found.hypothesis, excess, budget),
        };
        match shape {
            Shape::AsModelled => {}
            Shape::Simpler(simpler) => {
                found.hypothesis = simpler;
                return true;
            }
            Shape::Different(error, bright) => {
                let next = search_with_spot_error(space, compressed, frame, error, bright, budget);
                let is_simpler =
                    next.sources.len() < found.hypothesis.sources.len() && compressed.is_explained_by(&next);
                if !is_explained || is_simpler || self.spot_error.is_some() {
                    found.hypothesis = next;
                    found.spot_error = error;
                }
            }
        }
        false
    }

    /// The emitters under the spot error that recent frames showed, and whether this frame shows one around them.
    pub fn find_as_remembered(&mut self, error: f64, budgets: &mut Budgets) -> (Found, bool) {
        self.spot_error = Some(error);
        let mut found = self.find(budgets);
        self.allow_for_shape(&mut found, budgets);
        self.spot_error = None;
        found.kind = SearchKind::Reweighted;
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        let shown = shown_spot_error(space, compressed, frame, &found.hypothesis, false, budget);
        if shown > 0.0 {
            self.history.iter_mut().for_each(|history| history.push(shown));
            load_weighted(space, compressed, frame, error, &found.hypothesis.sources);
        }
        (found, shown > 0.0)
    }

    /// Takes the emitters under the remembered spot error where more are needed without it.
    pub fn keep_fewer(&mut self, found: &mut Found, remembered: Found) {
        if remembered.hypothesis.sources.len() < found.hypothesis.sources.len() {
            let Reweighting { space, compressed } = &mut self.reweighting;
            let (error, sources) = (remembered.spot_error, &remembered.hypothesis.sources);
            load_weighted(space, compressed, &self.frame, error, sources);
            *found = remembered;
        }
    }

    /// Remembers the spot error that the frame shows. Where emitters explain the frame and a lens does as well, the frames decide.
    pub fn remember_shape(&mut self, found: &mut Found, budgets: &mut Budgets) {
        let is_explained = self.compressed_of(found.kind).is_explained_by(&found.hypothesis);
        let Some(history) = self.history.as_mut().filter(|_| !found.hypothesis.sources.is_empty()) else {
            return;
        };
        if found.spot_error > 0.0 || !is_explained {
            history.push(found.spot_error);
            return;
        }
        let Reweighting { space, compressed } = &mut self.reweighting;
        let (frame, budget) = (&self.frame, &mut budgets.reweighting);
        let lens = try_spot_error(space, compressed, frame, &found.hypothesis, budget);
        history.push(lens.as_ref().map_or(0.0, |(error, _)| *error));
        if let (Some(error), Some((_, bright))) = (history.spot_error(), lens) {
            found.hypothesis = search_with_spot_error(space, compressed, frame, error, bright, budget);
            found.spot_error = error;
        }
    }
}
