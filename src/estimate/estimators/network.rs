//! The estimators with a learned part: the network's peaks alone, which is the paper's method, and the same as seeds of the
//! joint fit.

use crate::estimate::detect::heatmap_network::{Network, NetworkError};
use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::list::Learned;
use crate::estimate::estimators::network_start::network_sources;
use crate::estimate::fit::levenberg_marquardt::fit;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::candidate::Candidate;
use crate::estimate::model_order::refine::shrink;
use crate::estimate::model_order::search::SearchSpace;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::localise::localise;
use crate::frame::Frame;
use crate::optics::{Camera, Smear};

/// Steps of the joint fit from the network's peaks.
const STEPS: usize = 60;

/// A heatmap network, followed by the joint fit for `hybrid`.
pub(crate) struct NetworkEstimator {
    spec: Learned,
    network: Network,
    camera: Camera,
    frame: PreprocessedFrame,
    compressed: CompressedFrame,
    space: SearchSpace,
}

impl NetworkEstimator {
    pub fn new(
        spec: Learned,
        network: Option<&std::path::Path>,
        camera: &Camera,
        rules: Rules,
    ) -> Result<Self, NetworkError> {
        let basis = match camera.spot_shape {
            Some(_) => Basis::pixels,
            None => Basis::new,
        };
        let bases = [&camera.x, &camera.y].map(|axis| basis(axis, camera.spot_sigma_m));
        Ok(Self {
            spec,
            network: Network::load(network, camera.shape())?,
            camera: camera.clone(),
            frame: PreprocessedFrame::default(),
            compressed: CompressedFrame::of_camera(camera),
            space: SearchSpace::new(bases, rules).with_shape(camera),
        })
    }
}

impl Estimator for NetworkEstimator {
    fn name(&self) -> &'static str {
        self.spec.name()
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.frame.smear = smear.map(|s| s.displaced(&self.camera, 1.0));
    }

    /// The network's time is the same for every frame and the fit's steps are few: `_is_over` is not asked.
    fn estimate_until(&mut self, frame: &Frame, _is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        self.frame.load(frame, &self.camera)?;
        let camera = &self.camera;
        self.compressed
            .load(&self.frame, &self.space.bases.x, &self.space.bases.y);
        let mut hypothesis = Hypothesis::empty(Nuisances::default());
        hypothesis.sources = network_sources(&mut self.network, &self.frame, camera)?;
        let mut budget = WorkBudget::new(&|| false);
        let mut search = self.space.search(&self.compressed, &self.frame, &mut budget);
        if self.spec == Learned::Hybrid {
            fit(&mut search.context, &mut hypothesis, STEPS);
            let mut candidate = Candidate::from(hypothesis);
            shrink(&mut search, &mut candidate);
            hypothesis = candidate.into_hypothesis();
        }
        let found = localise(
            &mut search.context,
            &mut hypothesis,
            &self.frame,
            camera,
            camera.noise_std_j,
            None,
            None,
        );
        Ok(Estimate {
            emitters: found.emitters,
            estimator: self.name(),
            is_cut_short: false,
            is_limited: false,
            reduced_chi2: found.reduced_chi2,
            spot_error: 0.0,
            saturated_share: self.frame.saturated_share(),
            condition: found.condition,
            steps: budget.steps,
        })
    }
}
