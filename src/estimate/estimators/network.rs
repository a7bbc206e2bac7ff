//! The estimators with a learned part: the network's peaks alone, which is the paper's method, and the same as seeds of the
//! joint fit.

use crate::estimate::detect::heatmap_network::{Network, NetworkError};
use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::list::Learned;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise;
use crate::frame::Frame;
use crate::optics::{Camera, psf};

/// Steps of the joint fit from the network's peaks.
const STEPS: usize = 60;

/// A heatmap network, followed by the joint fit for `hybrid`.
pub(crate) struct NetworkEstimator {
    spec: Learned,
    network: Network,
    camera: Camera,
    frame: PreprocessedFrame,
    compressed: CompressedFrame,
    search: Search,
}

impl NetworkEstimator {
    pub fn new(
        spec: Learned,
        network: Option<&std::path::Path>,
        camera: &Camera,
        rules: Rules,
    ) -> Result<Self, NetworkError> {
        let bx = Basis::new(&camera.x, camera.spot_sigma_m);
        let by = Basis::new(&camera.y, camera.spot_sigma_m);
        Ok(Self {
            spec,
            network: Network::load(network, camera.shape())?,
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            compressed: CompressedFrame::default(),
            search: Search::new([bx, by], rules),
        })
    }
}

impl Estimator for NetworkEstimator {
    fn name(&self) -> &'static str {
        self.spec.name()
    }

    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        self.frame.load(frame, &self.camera)?;
        let Self {
            search,
            compressed,
            camera,
            ..
        } = self;
        compressed.load(&self.frame, &search.fitter.bx, &search.fitter.by);
        search.reset(None);
        let mut hypothesis = Hypothesis::empty(Nuisances::default());
        let sigma = camera.spot_sigma_m;
        for peak in self.network.run(&self.frame.pixels)? {
            let x = camera.x.centre(0) + peak.column * camera.x.pitch_m;
            let y = camera.y.centre(0) + peak.row * camera.y.pitch_m;
            let (row, column) = peak.pixel;
            // The energy of a lone source with this brightest pixel.
            let share = psf::pixel_fraction(camera.x.edge(column), camera.x.edge(column + 1), x, sigma)
                * psf::pixel_fraction(camera.y.edge(row), camera.y.edge(row + 1), y, sigma);
            hypothesis.sources.push(PointSource::new(
                [x / sigma, y / sigma],
                (self.frame.pixels[row * camera.x.n + column] / share).max(0.0),
            ));
        }
        if self.spec == Learned::Hybrid {
            search.fitter.fit(compressed, &mut hypothesis, STEPS);
            search.propose_shrinkage(compressed, &mut hypothesis);
        }
        let noise_j = camera.noise_std_j;
        let mut estimate = localise::localise(search, compressed, &mut hypothesis, &self.frame, camera, noise_j, None);
        estimate.estimator = self.spec.name();
        Ok(estimate)
    }
}
