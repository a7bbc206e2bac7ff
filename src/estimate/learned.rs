//! The rungs with a learned part: the network's peaks alone, which is the paper's method, and the same as seeds of the
//! joint fit.

use super::basis::Basis;
use super::model::{Model, Nuisances, Spot};
use super::network::{Network, NetworkError};
use super::reading::Reading;
use super::screen::Screened;
use super::search::Search;
use super::{Error, Estimate, Estimator, ground};
use crate::frame::Frame;
use crate::optics::{Camera, psf};

/// Steps of the joint fit from the network's peaks.
const STEPS: usize = 60;

/// A rung that a network stands in front of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Learned {
    /// The heatmap's maxima as they are.
    Network,
    /// The heatmap's maxima, fitted jointly; what the fit does not need is merged or dropped.
    Hybrid,
}

impl Learned {
    pub const ALL: [Self; 2] = [Self::Network, Self::Hybrid];

    /// What `[estimator] name` selects it by.
    pub fn name(self) -> &'static str {
        match self {
            Self::Network => "network",
            Self::Hybrid => "hybrid",
        }
    }

    pub fn summary(self) -> &'static str {
        match self {
            Self::Network => "maxima of a network's heatmap, after non-maximum suppression: the paper's method",
            Self::Hybrid => "the network's maxima as seeds of the joint fit",
        }
    }
}

/// A network with what follows it.
pub(super) struct LearnedEstimator {
    rung: Learned,
    network: Network,
    camera: Camera,
    frame: Screened,
    reading: Reading,
    search: Search,
}

impl LearnedEstimator {
    pub fn new(rung: Learned, network: Option<&std::path::Path>, camera: &Camera) -> Result<Self, NetworkError> {
        let bx = Basis::new(&camera.x, camera.spot_sigma_m);
        let by = Basis::new(&camera.y, camera.spot_sigma_m);
        Ok(Self {
            rung,
            network: Network::load(network, camera.shape())?,
            camera: camera.clone(),
            frame: Screened::default(),
            reading: Reading::default(),
            search: Search::new([bx, by]),
        })
    }
}

impl Estimator for LearnedEstimator {
    fn name(&self) -> &'static str {
        self.rung.name()
    }

    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        self.frame.load(frame, &self.camera)?;
        let Self {
            search,
            reading,
            camera,
            ..
        } = self;
        reading.load(&self.frame, &search.fitter.bx, &search.fitter.by);
        search.restart(None);
        let mut model = Model::empty(Nuisances::default());
        let sigma = camera.spot_sigma_m;
        for peak in self.network.run(&self.frame.pixels)? {
            let x = camera.x.centre(0) + peak.column * camera.x.pitch_m;
            let y = camera.y.centre(0) + peak.row * camera.y.pitch_m;
            let (row, column) = peak.pixel;
            // The energy of a lone spot with this brightest pixel.
            let share = psf::pixel_fraction(camera.x.edge(column), camera.x.edge(column + 1), x, sigma)
                * psf::pixel_fraction(camera.y.edge(row), camera.y.edge(row + 1), y, sigma);
            model.spots.push(Spot::new(
                [x / sigma, y / sigma],
                (self.frame.pixels[row * camera.x.n + column] / share).max(0.0),
            ));
        }
        if self.rung == Learned::Hybrid {
            search.fitter.fit(reading, &mut model, STEPS);
            search.shrink(reading, &mut model);
        }
        let noise_j = camera.noise_std_j;
        let mut estimate = ground::locate(search, reading, &mut model, &self.frame, camera, noise_j, None);
        estimate.rung = self.rung.name();
        Ok(estimate)
    }
}
