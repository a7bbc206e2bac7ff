//! The spots' width as frames show it together: where it differs from the configured one by little, a frame is explained by two sources for a spot as
//! well.

use crate::estimate::emitter::SecondMomentScore;
use crate::estimate::fit::source_groups::{linked, merged};
use crate::estimate::model::hypothesis::{
    Background, Hypothesis, INDEPENDENT, Nuisances, OVERLAPPING, PointSource, Width,
};
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::nuisance_selection::CLOSE_PAIR_DISTANCE;
use crate::estimate::model_order::search::Search;
use crate::optics::{Camera, SpotError};

/// Squared deviations from the width that spots were searched with from which on it is another.
const SHOWN: f64 = 25.0;
/// The same from which on every frame is looked at, and how many frames are one of that before.
const DOUBTED: f64 = 4.0;
const ONE_IN: u32 = 8;
/// Fewest spots that tell it: what one shows is none of the lens's.
const LEAST_TOLD: f64 = 3.5;
/// Decrease of the deviance that a further source's three numbers bring of noise alone.
const OF_NOISE: f64 = 3.0;
/// Frames after which what they say counts 1/e. More follow a lens that is warming up too late, fewer know the width less well.
const MEMORY: f64 = 50.0;
/// Least that ln width differs, at which no spot of SNR 1000 is a pair yet, and least of its spread from spot to spot: where spots differ as much it is
/// another shape, as coma.
const LEAST: f64 = 5e-4;
const SPREADS: f64 = 2.0;
/// Most that ln width differs for spots to be Gaussian still.
const MOST: f64 = 0.2;

/// What frames say of the spots' width.
#[derive(Default)]
pub(crate) struct WidthLearner {
    /// Frames and spots that told it, their information on ln width, its sum with what they show of it, and with the squared differences of a
    /// frame's spots from their mean.
    looks: f64,
    told: f64,
    information: f64,
    weighted: f64,
    squared: f64,
    /// Decrease of the deviance by sources close to each other in the place of single ones.
    of_close: f64,
    frames: u32,
}

impl WidthLearner {
    /// Where nobody has measured the spot.
    pub fn new(camera: &Camera) -> Option<Self> {
        (camera.spot_shape.is_none() && camera.spot_error == SpotError::AtLeast(0.0)).then(Self::default)
    }

    /// Counts a frame; whether it is to be looked at.
    pub fn is_due(&mut self) -> bool {
        self.frames += 1;
        self.frames < ONE_IN || self.frames.is_multiple_of(ONE_IN) || self.shown() > DOUBTED
    }

    /// Takes what explains a frame; returns the spots' width relative to that of `search`, once frames show that it is another. Spots that
    /// overlap with no other tell it; where there are none all do, of which sources within [`CLOSE_PAIR_DISTANCE`] may be one. Frames of spots that melt or
    /// are elongated say nothing, nor those with a background: where it is curved, spots look wider.
    pub fn learn(&mut self, search: &mut Search, found: &Hypothesis) -> Option<f64> {
        let spots = merged(&found.sources, CLOSE_PAIR_DISTANCE);
        let melt = search.pencil.is_some() && linked(&spots, INDEPENDENT).len() < spots.len();
        let is_round = matches!(found.nuisances.width, Width::Known | Width::Common);
        if spots.is_empty()
            || melt
            || !is_round
            || found.nuisances.background != Background::None
            || !search.is_explained_by(found)
        {
            return None;
        }
        let mut fitted = |sources: &[PointSource]| {
            let mut candidate = Candidate::from(found.clone());
            candidate.restrict_nuisances(Nuisances::default());
            candidate.sources = sources.to_vec();
            candidate.converged = false;
            search.fit_trial(&mut candidate);
            candidate
        };
        let mut shown = fitted(&found.sources);
        let mut alone = alone(&shown);
        let mut of_close = 0.0;
        if alone.is_empty() {
            let close = shown.deviance;
            shown = fitted(&spots);
            alone = (0..spots.len()).collect();
            of_close = shown.deviance - close - OF_NOISE * (found.sources.len() - spots.len()) as f64;
        }
        let inflation = search.criterion.noise_inflation;
        let scores = shown.second_moments(&mut search.context);
        let widths: Vec<_> = alone.iter().filter_map(|&i| ln_width(scores.get(i)?)).collect();
        let kept = 1.0 - 1.0 / MEMORY;
        for sum in [
            &mut self.looks,
            &mut self.told,
            &mut self.information,
            &mut self.weighted,
            &mut self.squared,
            &mut self.of_close,
        ] {
            *sum *= kept;
        }
        self.of_close += of_close / inflation;
        let sum = |of: fn(f64) -> f64| widths.iter().map(|(width, i)| i / inflation * of(*width)).sum::<f64>();
        let (information, weighted) = (sum(|_| 1.0), sum(|width| width));
        if information > 0.0 {
            self.looks += 1.0;
            self.told += widths.len() as f64;
            self.information += information;
            self.weighted += weighted;
            self.squared += sum(|width| width * width) - weighted * weighted / information;
        }
        (self.shown() > SHOWN).then(|| {
            let Self {
                weighted, information, ..
            } = std::mem::take(self);
            (weighted / information).exp()
        })
    }

    /// Squared deviations from the width that spots were searched with, as far as they agree; none where sources close to each other explain the
    /// frames better.
    fn shown(&self) -> f64 {
        if self.told < LEAST_TOLD {
            return 0.0;
        }
        let mean = self.weighted / self.information;
        let of_mean = self.weighted * mean;
        // One spot a frame differs from no other.
        let scatter = self.squared / (self.told - self.looks).max(1.0);
        let spread = ((scatter - 1.0).max(0.0) * self.told / self.information).sqrt();
        if of_mean > self.of_close && mean.abs() > LEAST.max(SPREADS * spread) {
            of_mean / scatter.max(1.0)
        } else {
            0.0
        }
    }
}

/// Indices of the sources that overlap with no other.
fn alone(hypothesis: &Hypothesis) -> Vec<usize> {
    let groups = linked(&hypothesis.sources, OVERLAPPING);
    let single = groups.into_iter().filter(|group| group.len() == 1);
    single.flatten().collect()
}

/// ln width of a source with this score, and the information on it.
fn ln_width(moments: &SecondMomentScore) -> Option<(f64, f64)> {
    let SecondMomentScore { score, information } = moments;
    // Spread by m along both axes a spot is √(1 + m) times as wide.
    let slope = 2.0 * (score[0] + score[2]);
    let curvature = 4.0 * (information[0][0] + 2.0 * information[0][2] + information[2][2]);
    let width = slope / curvature;
    (width.abs() < MOST).then_some((width, curvature))
}
