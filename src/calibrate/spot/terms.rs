//! How many separable terms a learned template has: the more, the closer to the template, and the closer to its noise.

use faer::linalg::triangular_solve::solve_upper_triangular_in_place;
use faer::{Mat, Par, Side};
use rayon::prelude::*;

use super::learn::Learner;
use super::patch::Buffers;
use super::template_model::TemplateModel;
use crate::optics::{Camera, SpotShape};

/// One term of a component: rank-one coefficients s·u·vᵀ.
struct Term {
    component: usize,
    /// Of the light's norm over the field.
    strength: f64,
    u: Vec<f64>,
    v: Vec<f64>,
}

impl Term {
    fn add(&self, model: &mut TemplateModel) {
        let (start, m) = model.block(self.component);
        for j in 0..m {
            for i in 0..m {
                model.coefficients[start + j * m + i] += self.u[j] * self.v[i];
            }
        }
    }
}

/// Excess of χ² a spot that is given for fewer terms: each costs every fit as much as a Gaussian does, and an excess of 0.3 moves a place
/// by a tenth of its standard deviation at most.
const PER_SPOT: f64 = 0.3;

/// Terms of all components, the strongest first (Eckart and Young, 1936), by what pixels see of them: details finer than a pixel are
/// mostly noise.
fn ranked(camera: &Camera, model: &TemplateModel) -> Vec<Term> {
    let mut found = Vec::new();
    for component in 0..model.components() {
        let (start, m) = model.block(component);
        let matrix = Mat::from_fn(m, m, |j, i| model.coefficients[start + j * m + i]);
        let (Some(ly), Some(lx)) = (
            seen(m, camera.y.pitch_m / model.knot_m),
            seen(m, camera.x.pitch_m / model.knot_m),
        ) else {
            continue;
        };
        let Ok(svd) = (ly.transpose() * matrix * &lx).thin_svd() else {
            continue;
        };
        // Back from what pixels see to coefficients.
        let (mut u, mut v) = (svd.U().to_owned(), svd.V().to_owned());
        solve_upper_triangular_in_place(ly.transpose(), u.as_mut(), Par::Seq);
        solve_upper_triangular_in_place(lx.transpose(), v.as_mut(), Par::Seq);
        let share = model.field_rms(component);
        for k in 0..m.min(SpotShape::MOST_TERMS) {
            let s = svd.S().column_vector()[k];
            found.push(Term {
                component,
                strength: s * share,
                u: (0..m).map(|j| s * u[(j, k)]).collect(),
                v: (0..m).map(|i| v[(i, k)]).collect(),
            });
        }
    }
    found.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    found.truncate(SpotShape::MOST_TERMS);
    found
}

/// Cholesky factor L of the Gram matrix of `m` splines that pixels `width` knots wide integrate, averaged over the pixel's phase.
fn seen(m: usize, width: f64) -> Option<Mat<f64>> {
    // The autocorrelation of cubic splines is a septic one, that of pixels a triangle; their convolution by the midpoint rule.
    const STEPS: usize = 64;
    let overlap = |k: usize| -> f64 {
        let places = (0..STEPS).map(|s| 2.0 * (s as f64 + 0.5) / STEPS as f64 - 1.0);
        let sum: f64 = places
            .map(|t| (1.0 - t.abs()) * spline(7, k as f64 - t * width + 4.0))
            .sum();
        sum * 2.0 / STEPS as f64
    };
    let overlaps: Vec<f64> = (0..m).map(overlap).collect();
    // What no pixel sees is kept away from zero.
    let gram = Mat::from_fn(m, m, |j, i| {
        overlaps[j.abs_diff(i)] + if i == j { 1e-6 * overlaps[0] } else { 0.0 }
    });
    let factors = gram.llt(Side::Lower).ok()?;
    let lower = factors.L();
    Some(Mat::from_fn(m, m, |j, i| if i <= j { lower[(j, i)] } else { 0.0 }))
}

/// Cardinal B-spline of a degree on [0, degree + 1] (de Boor, 1978, ch. IX).
fn spline(degree: u32, x: f64) -> f64 {
    if degree == 0 {
        return f64::from(u8::from((0.0..1.0).contains(&x)));
    }
    let n = f64::from(degree);
    if !(0.0..n + 1.0).contains(&x) {
        return 0.0;
    }
    (x * spline(degree - 1, x) + (n + 1.0 - x) * spline(degree - 1, x - 1.0)) / n
}

/// The model with its `count` strongest terms.
pub fn truncated(camera: &Camera, model: &TemplateModel, count: usize) -> TemplateModel {
    let mut out = model.clone();
    out.coefficients.fill(0.0);
    ranked(camera, model)
        .iter()
        .take(count)
        .for_each(|term| term.add(&mut out));
    out
}

/// The fewest terms with which the learner's patches, which its model has not seen, are explained as well as with more. Places,
/// energies and backgrounds follow to first order.
pub fn needed(learner: &Learner) -> usize {
    let model = &learner.model;
    let mut fewer = model.clone();
    fewer.coefficients.fill(0.0);
    let terms = ranked(learner.camera, model);
    let changes: Vec<Vec<f64>> = terms
        .iter()
        .map(|term| {
            term.add(&mut fewer);
            let pairs = fewer.coefficients.iter().zip(&model.coefficients);
            pairs.map(|(a, b)| a - b).collect()
        })
        .collect();
    let per_patch: Vec<Vec<f64>> = learner
        .patches
        .par_iter()
        .filter_map(|patch| {
            let linear = patch.linearise(learner.camera, model)?;
            let mut buffers = Buffers::default();
            let chi2 = |change: &Vec<f64>| {
                let mut residual = linear.template_change(patch, model, change, &mut buffers);
                residual.iter_mut().zip(&linear.residual).for_each(|(c, r)| *c = r - *c);
                linear.project(patch, &mut residual);
                residual.iter().map(|r| r * r).sum::<f64>()
            };
            Some(changes.iter().map(chi2).collect())
        })
        .collect();
    let chi2: Vec<f64> = (0..terms.len()).map(|k| per_patch.iter().map(|p| p[k]).sum()).collect();
    let least = chi2.iter().copied().fold(f64::INFINITY, f64::min);
    let enough = |c: &f64| *c <= least + PER_SPOT * learner.sources() as f64;
    chi2.iter().position(enough).map_or(1, |k| k + 1)
}
