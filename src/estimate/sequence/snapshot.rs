//! One frame of the window: its coefficients, and its log likelihood as a quadratic in the emitters' positions, energies projected out.

use std::sync::Arc;

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::{evaluate, linearise};
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::rules::Rules;

/// Relative increase of the energies' information before it is factorised: sources at one place leave it singular.
const RIDGE: f64 = 1e-13;

/// What fits of one snapshot after another share.
pub(crate) struct Engine<'a, 'b> {
    pub bases: &'a Bases,
    pub rules: Rules,
    pub budget: &'a mut WorkBudget<'b>,
    pub workspace: &'a mut Workspace,
}

/// A frame that the window holds.
#[derive(Clone)]
pub(crate) struct Snapshot {
    /// Seconds since the window's epoch.
    pub time_s: f64,
    pub compressed: Arc<CompressedFrame>,
    pub nuisances: Nuisances,
    pub local: LocalQuadratic,
}

/// −2 ln L of one frame about `positions`, with its energies and background at their best for every position (variable projection: Golub
/// and Pereyra, 1973; the information is Kaufman's, 1975): deviance − 2 gᵀδ + δᵀIδ.
#[derive(Clone, Debug, Default)]
pub(crate) struct LocalQuadratic {
    pub deviance: f64,
    /// (x, y) of each emitter, σ.
    pub positions: DVector<f64>,
    pub gradient: DVector<f64>,
    pub information: DMatrix<f64>,
    pub energies: Vec<f64>,
    /// Variances of the energies where the positions are known.
    pub energy_variances: Vec<f64>,
}

/// Sources at `positions` with signed energies.
pub(crate) fn hypothesis(positions: &DVector<f64>, nuisances: Nuisances) -> Hypothesis {
    let mut hypothesis = Hypothesis::empty(nuisances);
    hypothesis.has_signed_energies = true;
    let sources = positions.as_slice().chunks_exact(2);
    hypothesis
        .sources
        .extend(sources.map(|u| PointSource::new([u[0], u[1]], 0.0)));
    hypothesis
}

impl LocalQuadratic {
    /// Of a compressed frame with sources at `positions`.
    pub fn new(
        engine: &mut Engine,
        compressed: &CompressedFrame,
        nuisances: Nuisances,
        positions: DVector<f64>,
    ) -> Self {
        let mut hypothesis = hypothesis(&positions, nuisances);
        let problem = Problem {
            bases: engine.bases,
            compressed,
            constraint: None,
        };
        let at = linearise(problem, &mut hypothesis, engine.budget, engine.workspace);
        let n = hypothesis.sources.len();
        let (p, linear) = (at.equations.parameters, n + nuisances.background_terms());
        let h = &at.equations.information;
        let position = |k: usize| 3 * (k / 2) + k % 2;
        let energy = |k: usize| if k < n { 3 * k + 2 } else { 2 * n + k };
        let entry = |a: usize, b: usize| h[a.min(b) * p + a.max(b)];
        let mut inner = DMatrix::from_fn(linear, linear, |r, c| entry(energy(r), energy(c)));
        for k in 0..linear {
            inner[(k, k)] *= 1.0 + RIDGE;
            inner[(k, k)] += 1e-300;
        }
        let cross = DMatrix::from_fn(linear, 2 * n, |r, c| entry(energy(r), position(c)));
        let mut information = DMatrix::from_fn(2 * n, 2 * n, |r, c| entry(position(r), position(c)));
        let mut energy_variances = vec![f64::INFINITY; n];
        if let Some(factor) = Cholesky::new(inner) {
            let weights = factor.solve(&cross);
            information -= cross.transpose() * weights;
            let inverse = factor.inverse();
            energy_variances = (0..n).map(|k| inverse[(k, k)]).collect();
        }
        Self {
            deviance: hypothesis.deviance,
            gradient: DVector::from_fn(2 * n, |k, _| at.equations.gradient[position(k)]),
            information,
            energies: hypothesis.sources.iter().map(|s| s.a).collect(),
            energy_variances,
            positions,
        }
    }
}

/// The residual of `compressed` with sources at `positions`, (my, mx), and its square.
pub(crate) fn residual<'w>(
    engine: &'w mut Engine,
    compressed: &CompressedFrame,
    nuisances: Nuisances,
    positions: &DVector<f64>,
) -> (&'w [f64], f64) {
    let mut hypothesis = hypothesis(positions, nuisances);
    let mut context = FitContext {
        bases: engine.bases,
        compressed,
        rules: engine.rules,
        budget: engine.budget,
        workspace: engine.workspace,
    };
    evaluate(&mut context, &mut hypothesis);
    (&engine.workspace.current.residual, hypothesis.deviance)
}
