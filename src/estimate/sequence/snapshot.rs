//! A frame that the window holds, and how it sees the places that the window follows.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Nuisances;
use crate::estimate::sequence::local_quadratic::{Energies, Engine, LocalQuadratic};
use crate::estimate::sequence::outlook::{FrameFit, Outlook};

/// Work of finding where a place lies on the sensor of a moving platform, for one of its coordinates, in operations.
const OUTLOOK_WORK: f64 = 500.0;

/// A frame that the window holds.
#[derive(Clone)]
pub(crate) struct Snapshot {
    /// Seconds since the window's epoch.
    pub time_s: f64,
    pub compressed: Arc<CompressedFrame>,
    pub nuisances: Nuisances,
    /// How it sees places on the ground; `None`: places are positions on the sensor.
    pub outlook: Option<Arc<Outlook>>,
    /// About places.
    pub local: LocalQuadratic,
}

impl Snapshot {
    pub fn new(time_s: f64, compressed: Arc<CompressedFrame>, outlook: Option<Arc<Outlook>>) -> Self {
        Self {
            time_s,
            compressed,
            nuisances: Nuisances::default(),
            outlook,
            local: LocalQuadratic::default(),
        }
    }

    /// The frame about `places`.
    pub fn about(&self, engine: &mut Engine, energies: Energies, places: DVector<f64>) -> LocalQuadratic {
        match &self.outlook {
            None => LocalQuadratic::new(engine, &self.compressed, energies, self.nuisances, places),
            Some(outlook) => self.fit(engine, energies, &places, outlook).about(places),
        }
    }

    fn fit(&self, engine: &mut Engine, energies: Energies, places: &DVector<f64>, outlook: &Outlook) -> FrameFit {
        let view = view(engine.bases);
        outlook.fit(places, self.local.pose_error, view, |positions| {
            engine.budget.charge(OUTLOOK_WORK * positions.len() as f64);
            LocalQuadratic::new(engine, &self.compressed, energies, self.nuisances, positions)
        })
    }

    /// Positions on the sensor, σ, of `places`, the pose error at its best for these, and their covariance where that of the places is `cov`,
    /// which holds what this frame says.
    pub fn on_sensor(
        &self,
        engine: &mut Engine,
        energies: Energies,
        places: DVector<f64>,
        cov: DMatrix<f64>,
    ) -> (DVector<f64>, DMatrix<f64>) {
        match &self.outlook {
            None => (places, cov),
            Some(outlook) => {
                let fit = self.fit(engine, energies, &places, outlook);
                let cov = fit.cov_on_sensor(&cov);
                (fit.local.positions, cov)
            }
        }
    }

    /// Positions on the sensor, σ, of `places`, with the pose error that the frame was found to have.
    pub fn positions(&self, bases: &Bases, places: DVector<f64>) -> DVector<f64> {
        match &self.outlook {
            None => places,
            Some(outlook) => outlook.show(&places, &self.local.pose_error, view(bases)).positions,
        }
    }

    /// The place that a position on the sensor, σ, shows; `None` where that is no ground.
    pub fn place(&self, position: [f64; 2]) -> Option<[f64; 2]> {
        match &self.outlook {
            None => Some(position),
            Some(outlook) => outlook.place(position, &self.local.pose_error),
        }
    }
}

/// Where emitters may be on the sensor, σ.
pub(crate) fn view(bases: &Bases) -> [[f64; 2]; 2] {
    bases.axes().map(|b| [b.min_position(), b.max_position()])
}
