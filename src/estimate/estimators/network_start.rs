//! The embedded network's maxima as the start of the search of a crowded frame: they cost the same however many emitters there are.

use crate::estimate::detect::heatmap_network::{Card, Network};
use crate::estimate::error::Error;
use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::optics::{Camera, psf};

/// Residual peaks from which a frame is crowded: a network takes as long as the search of some ten emitters.
const CROWDED: usize = 10;
/// Steps of the joint fit from the network's maxima.
const STEPS: usize = 60;
/// A spot may be wider or narrower than those that the network was trained on by this share.
const NEARLY: f64 = 0.1;

/// A network's maxima as sources, with the energy of a lone source that has their brightest pixel.
pub(crate) fn network_sources(
    network: &mut Network,
    frame: &PreprocessedFrame,
    camera: &Camera,
) -> Result<Vec<PointSource>, Error> {
    let (x, y, sigma) = (&camera.x, &camera.y, camera.spot_sigma_m);
    let peaks = network.run(&frame.pixels)?.iter().map(|peak| {
        let at = [
            x.centre(0) + peak.column * x.pitch_m,
            y.centre(0) + peak.row * y.pitch_m,
        ];
        let (row, column) = peak.pixel;
        let share = psf::pixel_fraction(x.edge(column), x.edge(column + 1), at[0], sigma)
            * psf::pixel_fraction(y.edge(row), y.edge(row + 1), at[1], sigma);
        let energy = (frame.pixels[row * x.n + column] / share).max(0.0);
        PointSource::new(at.map(|v| v / sigma), energy)
    });
    Ok(peaks.collect())
}

/// A network to start searches with; loaded with the first crowded frame.
pub(crate) struct NetworkStart {
    camera: Camera,
    /// Whether the embedded network is for such frames, and can be run.
    is_fit: bool,
    network: Option<Network>,
}

impl NetworkStart {
    pub fn new(camera: &Camera, is_wanted: bool) -> Self {
        let width = [&camera.x, &camera.y].map(|axis| camera.spot_sigma_m / axis.pitch_m);
        let is_near = |trained: f64| width.iter().all(|w| (w / trained - 1.0).abs() < NEARLY);
        let is_of = |card: Card| card.takes(camera.shape()) && card.spot_sigma_px.is_some_and(is_near);
        Self {
            camera: camera.clone(),
            is_fit: is_wanted && Card::embedded().is_ok_and(is_of),
            network: None,
        }
    }

    /// Starts from the network's maxima instead of `initial`, where that shows a crowd and they are better.
    pub fn improve(&mut self, search: &mut Search, initial: &mut Hypothesis) {
        if !self.is_fit || initial.sources.len() < CROWDED {
            return;
        }
        if self.network.is_none() {
            self.network = Network::load(None, self.camera.shape()).ok();
        }
        let network = self.network.as_mut();
        let Some(sources) = network.and_then(|n| network_sources(n, search.frame, &self.camera).ok()) else {
            self.is_fit = false;
            return;
        };
        let mut seeded = Hypothesis::empty(initial.nuisances);
        seeded.sources = sources;
        fit(&mut search.context, &mut seeded, STEPS);
        if search.score(&seeded) < search.score(initial) {
            *initial = seeded;
        }
    }
}
