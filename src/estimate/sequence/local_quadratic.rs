//! The log likelihood of one frame as a quadratic in the emitters' positions, energies projected out.

use nalgebra::{Cholesky, DMatrix, DVector, Vector6};

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::{evaluate, linearise};
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::rules::Rules;
use crate::estimate::sequence::target::Light;

/// Relative increase of the energies' information before it is factorised: sources at one place leave it singular.
const RIDGE: f64 = 1e-13;

/// What fits of one snapshot after another share.
pub(crate) struct Engine<'a, 'b> {
    pub bases: &'a Bases,
    pub rules: Rules,
    pub budget: &'a mut WorkBudget<'b>,
    pub workspace: &'a mut Workspace,
}

/// What the energies of emitters may be in the snapshots of a window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Energies {
    /// Light: frames.
    #[default]
    NonNegative,
    /// Sums of light with signs: the principal components of frames.
    Signed,
}

impl Energies {
    /// Share of the snapshots in which noise lights an emitter that is none.
    pub fn lit_by_noise(self) -> f64 {
        match self {
            Self::NonNegative => 0.5,
            Self::Signed => 1.0,
        }
    }
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
    /// Variances of the energies where the positions are known, were all of them free.
    pub energy_variances: Vec<f64>,
    /// Which energies are not at zero, where they may not be below it.
    pub is_lit: Vec<bool>,
    /// The error of the frame's pose at its best, in standard deviations of it; see `outlook`.
    pub pose_error: Vector6<f64>,
}

/// Sources at `positions`.
pub(crate) fn hypothesis(positions: &DVector<f64>, energies: Energies, nuisances: Nuisances) -> Hypothesis {
    let mut hypothesis = Hypothesis::empty(nuisances);
    hypothesis.has_signed_energies = energies == Energies::Signed;
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
        energies: Energies,
        nuisances: Nuisances,
        positions: DVector<f64>,
    ) -> Self {
        let mut hypothesis = hypothesis(&positions, energies, nuisances);
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
        let factor = |of: &[usize]| {
            let mut inner = DMatrix::from_fn(of.len(), of.len(), |r, c| entry(energy(of[r]), energy(of[c])));
            for k in 0..of.len() {
                inner[(k, k)] *= 1.0 + RIDGE;
                inner[(k, k)] += 1e-300;
            }
            Cholesky::new(inner)
        };
        let all: Vec<usize> = (0..linear).collect();
        let is_free = at.scratch.amplitudes.is_free();
        let free: Vec<usize> = all.iter().copied().filter(|&k| is_free[k]).collect();
        let mut information = DMatrix::from_fn(2 * n, 2 * n, |r, c| entry(position(r), position(c)));
        let mut energy_variances = vec![f64::INFINITY; n];
        let known_free = factor(&free);
        if let Some(factor) = &known_free {
            let mut cross = DMatrix::from_fn(free.len(), 2 * n, |r, c| entry(energy(free[r]), position(c)));
            factor.l_dirty().solve_lower_triangular_mut(&mut cross);
            information -= cross.transpose() * cross;
        }
        let known = if free.len() == linear { known_free } else { factor(&all) };
        if let Some(factor) = known {
            let mut root = DMatrix::identity(linear, linear);
            factor.l_dirty().solve_lower_triangular_mut(&mut root);
            energy_variances = (0..n).map(|k| root.column(k).norm_squared()).collect();
        }
        let is_lit = is_free[..n].to_vec();
        Self {
            deviance: hypothesis.deviance,
            gradient: DVector::from_fn(2 * n, |k, _| at.equations.gradient[position(k)]),
            information,
            energies: hypothesis
                .sources
                .iter()
                .zip(&is_lit)
                .map(|(s, lit)| if *lit { s.a } else { 0.0 })
                .collect(),
            energy_variances,
            is_lit,
            positions,
            pose_error: Vector6::zeros(),
        }
    }

    /// Moves it out; what is left is where to look for the pose error.
    pub fn take(&mut self) -> Self {
        let left = Self {
            pose_error: self.pose_error,
            ..Self::default()
        };
        std::mem::replace(self, left)
    }

    /// −2 ln L of the frame with its emitters at `positions`, as far as the quadratic holds.
    pub fn cost(&self, positions: &DVector<f64>) -> f64 {
        let step = positions - &self.positions;
        self.deviance - 2.0 * self.gradient.dot(&step) + (&self.information * &step).dot(&step)
    }

    /// What the light of each emitter weighs; none, where the frame was not linearised yet.
    pub fn lights(&self) -> impl Iterator<Item = Light> {
        let energies = self.energies.iter().zip(&self.energy_variances);
        energies.zip(&self.is_lit).map(|((energy, variance), is_lit)| Light {
            evidence: energy * energy / variance,
            lit: f64::from(*is_lit),
        })
    }
}

/// The residual of `compressed` with sources at `positions`, (my, mx), and its square.
pub(crate) fn residual<'w>(
    engine: &'w mut Engine,
    compressed: &CompressedFrame,
    energies: Energies,
    nuisances: Nuisances,
    positions: &DVector<f64>,
) -> (&'w [f64], f64) {
    let mut hypothesis = hypothesis(positions, energies, nuisances);
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

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::{Energies, Engine, LocalQuadratic};
    use crate::estimate::fit::work_budget::WorkBudget;
    use crate::estimate::model::hypothesis::Nuisances;
    use crate::estimate::test_frame::{Shown, TestFrame};

    fn local(test: &mut TestFrame, energies: Energies, positions: &[f64]) -> LocalQuadratic {
        let mut engine = Engine {
            bases: &test.space.bases,
            rules: Default::default(),
            budget: &mut WorkBudget::new(&|| false),
            workspace: &mut test.space.workspace,
        };
        let positions = DVector::from_column_slice(positions);
        LocalQuadratic::new(&mut engine, &test.compressed, energies, Nuisances::default(), positions)
    }

    fn one_spot() -> TestFrame {
        Shown {
            pixels_per_sigma: 2.0,
            sources: &[([0.3, -0.4], 200.0)],
            noise: Some(5),
            ..Shown::default()
        }
        .frame()
    }

    #[test]
    fn light_below_zero_explains_nothing() {
        let mut test = one_spot();
        // Beside the spot, and 0.2 σ from each other: opposite lights would shift it.
        let pair = [0.45, -0.4, 0.65, -0.4];
        let signed = local(&mut test, Energies::Signed, &pair);
        let light = local(&mut test, Energies::NonNegative, &pair);
        assert!(
            signed.energies[0] > 200.0 && signed.energies[1] < 0.0,
            "{:?}",
            signed.energies
        );
        assert_eq!((&light.is_lit[..], light.energies[1]), (&[true, false][..], 0.0));
        let alone = local(&mut test, Energies::NonNegative, &pair[..2]);
        let std = alone.energy_variances[0].sqrt();
        assert!((light.energies[0] - alone.energies[0]).abs() < 0.1 * std);
        assert!(light.deviance > signed.deviance + 10.0);
        // But for the little light that gives a dark emitter's position a gradient.
        assert!((light.deviance - alone.deviance).abs() < 1.0);
    }

    #[test]
    fn the_gradient_is_that_of_the_deviance_with_dark_emitters_at_zero() {
        let mut test = one_spot();
        let at = [0.35, -0.42, 0.65, -0.3];
        let quadratic = local(&mut test, Energies::NonNegative, &at);
        assert_eq!(quadratic.is_lit, [true, false]);
        for k in 0..4 {
            let h = 1e-5;
            let mut deviance = |sign: f64| {
                let mut moved = at;
                moved[k] += sign * h;
                local(&mut test, Energies::NonNegative, &moved).deviance
            };
            let slope = (deviance(1.0) - deviance(-1.0)) / (2.0 * h);
            let expected = -2.0 * quadratic.gradient[k];
            assert!(
                (slope - expected).abs() < 1e-3 * (1.0 + expected.abs()),
                "{k}: {slope} against {expected}"
            );
        }
    }
}
