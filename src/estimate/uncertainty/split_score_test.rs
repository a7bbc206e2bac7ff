//! Score test of a split (Rao, 1948). Two unresolved emitters look like one whose light is spread along the line between them: the
//! score in the second moments, projected off the fitted parameters, tests for that.

use crate::estimate::dense_linalg::{axpy, dispatch, dot};
use crate::estimate::emitter::SecondMomentScore;
use crate::estimate::fit::levenberg_marquardt::Linearisation;
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::measured_components::Orders;
use crate::estimate::model::separable_model::{SLOPES, SeparableModel};
use crate::estimate::uncertainty::covariance::Covariance;

/// Orders and factors of the derivatives for the second moments xx, xy, yy: a source spread by M changes by
/// ½A(M_xx f_xx + 2 M_xy f_xy + M_yy f_yy).
const SECOND_ORDERS: Orders = [[2, 0], [1, 1], [0, 2]];
const SECOND_FACTORS: [f64; 3] = [0.5, 1.0, 0.5];
/// Directions tested, over half a turn: the best is missed by at most 6°.
const DIRECTIONS: usize = 16;
/// Smallest share of a moment's information that must remain after projection off the fitted parameters: less is rounding.
const LEAST: f64 = 1e-6;

/// A split suggested by a second-moment score.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SplitProposal {
    /// Predicted decrease of the deviance, to second order.
    pub gain: f64,
    pub index: usize,
    pub direction: [f64; 2],
    /// Distance of equal halves from the source, σ.
    pub distance: f64,
}

/// The split of source `index` along the direction of the largest gain, if any gains.
pub(crate) fn split_proposal(score: &SecondMomentScore, index: usize) -> Option<SplitProposal> {
    let (g, s) = (&score.score, &score.information);
    let along = |k: usize| {
        let (y, x) = (std::f64::consts::PI * k as f64 / DIRECTIONS as f64).sin_cos();
        let v = [x * x, x * y, y * y];
        let slope: f64 = (0..3).map(|r| g[r] * v[r]).sum();
        let curvature: f64 = (0..3).map(|r| v[r] * (0..3).map(|c| s[r][c] * v[c]).sum::<f64>()).sum();
        (slope > 0.0 && curvature > 0.0).then(|| SplitProposal {
            gain: slope * slope / curvature,
            index,
            direction: [x, y],
            distance: (slope / curvature).sqrt(),
        })
    };
    (0..DIRECTIONS)
        .filter_map(along)
        .max_by(|a, b| a.gain.total_cmp(&b.gain))
}

/// Second-moment score of each source of a linearised hypothesis, given the inverse of its information.
pub(crate) fn second_moment_scores(
    problem: Problem,
    at: &mut Linearisation,
    covariance: &Covariance,
    budget: &mut WorkBudget,
) -> Vec<SecondMomentScore> {
    let (n, p) = (at.equations.sources, at.equations.parameters);
    budget.charge((n * p * 3 * p) as f64);
    dispatch!(<'a, 'w, 'c>
        problem: Problem<'a> = problem,
        at: &'c mut Linearisation<'w> = at,
        covariance: &'c Covariance = covariance
        => Vec<SecondMomentScore>: projected_scores(problem, at, covariance))
}

#[inline(always)]
fn projected_scores(problem: Problem, at: &mut Linearisation, covariance: &Covariance) -> Vec<SecondMomentScore> {
    let (n, p) = (at.equations.sources, at.equations.parameters);
    let (mut cross, mut taken) = (vec![0.0; 3 * p], vec![0.0; 3 * p]);
    let mut scores = Vec::with_capacity(n);
    for i in 0..n {
        cross.fill(0.0);
        let (mut score, mut information) = unprojected_score(problem, at, i, &mut cross);
        let whole = information;
        for r in 0..3 {
            for k in 0..p {
                taken[r * p + k] = dot(&cross[r * p..(r + 1) * p], &covariance.matrix[k * p..(k + 1) * p]);
            }
        }
        for r in 0..3 {
            let taken = &taken[r * p..(r + 1) * p];
            score[r] -= dot(taken, &at.equations.gradient);
            for c in 0..3 {
                information[r][c] -= dot(taken, &cross[c * p..(c + 1) * p]);
            }
        }
        let is_left = (0..3).all(|r| information[r][r] > LEAST * whole[r][r]);
        scores.push(if is_left {
            SecondMomentScore { score, information }
        } else {
            SecondMomentScore::default()
        });
    }
    scores
}

/// Score and information of source `i`'s second moments, and their cross information with the model's parameters, (3, p).
#[inline(always)]
fn unprojected_score(
    problem: Problem,
    at: &mut Linearisation,
    i: usize,
    cross: &mut [f64],
) -> ([f64; 3], [[f64; 3]; 3]) {
    let p = cross.len() / 3;
    let compressed = problem.compressed;
    let model = &at.evaluation.model;
    let widths = at.equations.widths();
    let own = SECOND_FACTORS.map(|f| f * model.amplitude(i));
    let strip = &mut at.scratch.strip;
    let mut information = [[0.0; 3]; 3];
    if compressed.weights.is_empty() && compressed.masked.runs().is_empty() && widths.is_empty() && model.is_upright() {
        let products = model.inner_products(i, SECOND_ORDERS, i, SECOND_ORDERS, &[], strip);
        information = information_of(own, products);
        cross_information(model, i, own, cross);
        let row = &mut at.scratch.vector;
        row.resize(p, 0.0);
        for bad in compressed.masked.scattered() {
            let values = model.derivatives_at(i, [bad.x, bad.y], SECOND_ORDERS);
            if values == [0.0; 3] {
                continue;
            }
            model.jacobian_row_at([bad.x, bad.y], row);
            for r in 0..3 {
                axpy(-own[r] * values[r], row, &mut cross[r * p..(r + 1) * p]);
                for c in 0..3 {
                    information[r][c] -= own[r] * values[r] * own[c] * values[c];
                }
            }
        }
    } else if model.is_measured() {
        let weights = &compressed.weights;
        let products = model.inner_products(i, SECOND_ORDERS, i, SECOND_ORDERS, weights, strip);
        information = information_of(own, products);
        for j in 0..model.components() {
            let products = model.inner_products(i, SECOND_ORDERS, j, SLOPES, weights, strip);
            for r in 0..3 {
                let products = [0, 1, 2].map(|c| own[r] * products[3 * r + c]);
                model.set_jacobian(j, products, &mut cross[r * p..(r + 1) * p]);
            }
        }
    } else {
        let derivative = &mut at.scratch.matrix;
        for (r, second) in SECOND_ORDERS.into_iter().enumerate() {
            derivative.clear();
            derivative.resize(compressed.mx * compressed.my, 0.0);
            model.accumulate(i, second[0], second[1], own[r], derivative);
            compressed.apply_weights(derivative, problem.bases.axes(), false, &mut at.scratch.profiles);
            let row = &mut cross[r * p..(r + 1) * p];
            model.transposed_jacobian_times(derivative, strip, row);
            for (w, width) in widths.iter().enumerate() {
                row[p - widths.len() + w] = dot(derivative, width);
            }
            let projected = model.project_second_derivatives(i, derivative, strip);
            for c in 0..3 {
                information[r][c] = own[c] * projected[c];
            }
        }
    }
    let projected = model.project_second_derivatives(i, &at.evaluation.residual, strip);
    ([0, 1, 2].map(|r| own[r] * projected[r]), information)
}

#[inline(always)]
fn information_of(own: [f64; 3], products: [f64; 9]) -> [[f64; 3]; 3] {
    let mut information = [[0.0; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            information[r][c] = own[r] * own[c] * products[3 * r + c];
        }
    }
    information
}

/// Cross information of source `i`'s second moments with all parameters in an unweighted frame, (3, p).
#[inline(always)]
fn cross_information(model: &SeparableModel, i: usize, own: [f64; 3], cross: &mut [f64]) {
    let (n, p) = (model.sources.len(), cross.len() / 3);
    for j in 0..model.components() {
        let Some([x, y]) = model.axis_inner_products(i, j) else {
            continue;
        };
        for (r, second) in SECOND_ORDERS.into_iter().enumerate() {
            let along = |first: [usize; 2]| own[r] * x[second[0]][first[0]] * y[second[1]][first[1]];
            if j >= n {
                cross[r * p + 2 * n + j] = along([0, 0]);
                continue;
            }
            let a = model.amplitude(j);
            cross[r * p + 3 * j] = a * along([1, 0]);
            cross[r * p + 3 * j + 1] = a * along([0, 1]);
            cross[r * p + 3 * j + 2] = along([0, 0]);
        }
    }
}
