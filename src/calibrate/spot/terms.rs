//! A learned template as few separable terms, whose weights change over the field: the more, the closer to the template, and the closer to its noise.

use faer::linalg::solvers::Solve;
use faer::linalg::triangular_solve::solve_upper_triangular_in_place;
use faer::{Mat, Par, Side};
use rayon::prelude::*;

use super::learn::Learner;
use super::patch::Buffers;
use super::template_model::TemplateModel;
use crate::optics::spot::FieldPolynomial;
use crate::optics::{Camera, SpotShape};

/// Σ_k w_k(u, v)·a_k(y)·b_k(x): columns of coefficients, one a term.
#[derive(Clone, Debug)]
pub struct Separable {
    /// Of the field's polynomials, as the template has them.
    weights: Mat<f64>,
    y: Mat<f64>,
    x: Mat<f64>,
}

/// Excess of χ² a spot that is given for fewer terms: each costs every fit as much as a Gaussian does, and an excess of 0.3 moves a place
/// by a tenth of its standard deviation at most.
const PER_SPOT: f64 = 0.3;
/// Numbers of terms that are tried.
const COUNTS: [usize; 12] = [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, SpotShape::MOST_TERMS];
/// Largest number of rounds, and the relative fall of what is left out below which there are no more.
const ROUNDS: usize = 300;
const SETTLED: f64 = 1e-3;
/// Keeps terms that would cancel each other from growing.
const RIDGE: f64 = 1e-9;

impl Separable {
    /// The `count` terms that leave out least of a template, as a share of what pixels see of it over the field: details finer than a pixel
    /// are mostly noise. Begins with the strongest terms of each component (Eckart and Young, 1936), then each factor in turn is the best for
    /// the others (Carroll and Chang, 1970; Harshman, 1970). None where nothing is seen.
    pub fn of(camera: &Camera, model: &TemplateModel, count: usize) -> Option<Self> {
        let n = model.n;
        let ly = seen(n, camera.y.pitch_m / model.knot_m)?;
        let lx = seen(n, camera.x.pitch_m / model.knot_m)?;
        let slices: Vec<Mat<f64>> = (0..model.components())
            .map(|c| ly.transpose() * model.component(c) * &lx * model.field_rms(c))
            .collect();
        let mut terms = Self::strongest(&slices, count)?;
        let mut before = f64::INFINITY;
        for _ in 0..ROUNDS {
            if terms.improve(&slices).is_none() {
                break;
            }
            let left = terms.left_out(&slices);
            if before - left < SETTLED * left {
                break;
            }
            before = left;
        }
        // Back from what pixels see to coefficients.
        solve_upper_triangular_in_place(ly.transpose(), terms.y.as_mut(), Par::Seq);
        solve_upper_triangular_in_place(lx.transpose(), terms.x.as_mut(), Par::Seq);
        for c in 0..slices.len() {
            (0..terms.weights.ncols()).for_each(|k| terms.weights[(c, k)] /= model.field_rms(c));
        }
        Some(terms)
    }

    fn strongest(slices: &[Mat<f64>], count: usize) -> Option<Self> {
        let mut found: Vec<(f64, usize, Vec<f64>, Vec<f64>)> = Vec::new();
        for (c, slice) in slices.iter().enumerate() {
            let svd = slice.thin_svd().ok()?;
            for k in 0..slice.nrows().min(count) {
                let column = |m: faer::MatRef<f64>| (0..m.nrows()).map(|i| m[(i, k)]).collect();
                found.push((svd.S().column_vector()[k], c, column(svd.U()), column(svd.V())));
            }
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(count);
        let n = slices.first()?.nrows();
        Some(Self {
            weights: Mat::from_fn(slices.len(), found.len(), |c, k| {
                if found[k].1 == c { found[k].0 } else { 0.0 }
            }),
            y: Mat::from_fn(n, found.len(), |j, k| found[k].2[j]),
            x: Mat::from_fn(n, found.len(), |i, k| found[k].3[i]),
        })
    }

    /// Alternating least squares: each factor once.
    fn improve(&mut self, slices: &[Mat<f64>]) -> Option<()> {
        let (n, count) = (self.y.nrows(), self.weights.ncols());
        let mut right = Mat::<f64>::zeros(n, count);
        for (c, slice) in slices.iter().enumerate() {
            right += weighted(&(slice * &self.x), &self.weights, c);
        }
        self.y = best(right, &self.x, &self.weights)?;
        unit(&mut self.y);
        let mut right = Mat::<f64>::zeros(n, count);
        for (c, slice) in slices.iter().enumerate() {
            right += weighted(&(slice.transpose() * &self.y), &self.weights, c);
        }
        self.x = best(right, &self.y, &self.weights)?;
        unit(&mut self.x);
        let mut right = Mat::<f64>::zeros(slices.len(), count);
        for (c, slice) in slices.iter().enumerate() {
            let along = slice * &self.x;
            for k in 0..count {
                right[(c, k)] = (0..n).map(|j| along[(j, k)] * self.y[(j, k)]).sum();
            }
        }
        self.weights = best(right, &self.y, &self.x)?;
        Some(())
    }

    fn left_out(&self, slices: &[Mat<f64>]) -> f64 {
        let of = |(c, slice): (usize, &Mat<f64>)| {
            (slice - weighted(&self.y, &self.weights, c) * self.x.transpose()).squared_norm_l2()
        };
        slices.iter().enumerate().map(of).sum()
    }

    /// As a template on the knots of `model`.
    pub fn template(&self, model: &TemplateModel) -> TemplateModel {
        let mut out = model.filled();
        for c in 0..out.components() {
            let (start, m) = out.block(c);
            let light = weighted(&self.y, &self.weights, c) * self.x.transpose();
            for j in 0..m {
                (0..m).for_each(|i| out.coefficients[start + j * m + i] = light[(j, i)]);
            }
        }
        out
    }

    /// As the optics takes it.
    pub fn shape(&self, model: &TemplateModel) -> Option<SpotShape> {
        let terms = (0..self.weights.ncols()).map(|k| {
            let mut weight = vec![0.0; FieldPolynomial::length(model.degree)];
            for c in 0..model.components() {
                for (w, p) in weight.iter_mut().zip(model.field_polynomial(c)) {
                    *w += self.weights[(c, k)] * p;
                }
            }
            (
                FieldPolynomial(weight),
                self.y.col_as_slice(k).to_vec(),
                self.x.col_as_slice(k).to_vec(),
            )
        });
        SpotShape::from_terms(model.field, model.knot_m, terms)
    }

    /// The fewest terms with which the learner's patches, which its model has not seen, are explained as well as with more. Places,
    /// energies and backgrounds follow to first order.
    pub fn needed(learner: &Learner) -> Option<usize> {
        let model = learner.model.filled();
        let found: Vec<(usize, Vec<f64>)> = COUNTS
            .into_par_iter()
            .filter_map(|count| {
                let fewer = Self::of(learner.camera, &model, count)?.template(&model);
                let pairs = fewer.coefficients.iter().zip(&model.coefficients);
                Some((count, pairs.map(|(a, b)| a - b).collect()))
            })
            .collect();
        let per_patch: Vec<Vec<f64>> = learner
            .patches
            .par_iter()
            .filter_map(|patch| {
                let linear = patch.linearise(learner.camera, &model)?;
                let mut buffers = Buffers::default();
                let chi2 = |(_, change): &(usize, Vec<f64>)| {
                    let mut residual = linear.template_change(patch, &model, change, &mut buffers);
                    residual.iter_mut().zip(&linear.residual).for_each(|(c, r)| *c = r - *c);
                    linear.project(patch, &mut residual);
                    residual.iter().map(|r| r * r).sum::<f64>()
                };
                Some(found.iter().map(chi2).collect())
            })
            .collect();
        let chi2: Vec<f64> = (0..found.len()).map(|k| per_patch.iter().map(|p| p[k]).sum()).collect();
        let least = chi2.iter().copied().fold(f64::INFINITY, f64::min);
        let enough = |c: &f64| *c <= least + PER_SPOT * learner.sources() as f64;
        chi2.iter().position(enough).map(|k| found[k].0)
    }
}

/// Columns times the weights of component `c`.
fn weighted(columns: &Mat<f64>, weights: &Mat<f64>, c: usize) -> Mat<f64> {
    Mat::from_fn(columns.nrows(), columns.ncols(), |j, k| {
        columns[(j, k)] * weights[(c, k)]
    })
}

/// The factor that is best for two others, `right` being the tensor against these.
fn best(right: Mat<f64>, a: &Mat<f64>, b: &Mat<f64>) -> Option<Mat<f64>> {
    let (ga, gb) = (a.transpose() * a, b.transpose() * b);
    let count = a.ncols();
    let mut gram = Mat::from_fn(count, count, |k, l| ga[(k, l)] * gb[(k, l)]);
    let largest = (0..count).map(|k| gram[(k, k)]).fold(0.0, f64::max);
    (0..count).for_each(|k| gram[(k, k)] += RIDGE * largest);
    Some(
        gram.llt(Side::Lower)
            .ok()?
            .solve(right.transpose())
            .transpose()
            .to_owned(),
    )
}

/// Makes columns of unit length.
fn unit(columns: &mut Mat<f64>) {
    for k in 0..columns.ncols() {
        let column = columns.col_as_slice_mut(k);
        let length = column.iter().map(|v| v * v).sum::<f64>().sqrt();
        if length > 0.0 {
            column.iter_mut().for_each(|v| *v /= length);
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics;

    /// Two separable terms, each of which has a share of every component of the field.
    #[test]
    fn terms_share_the_components_of_the_field() {
        let config = optics::Config {
            pixels: [40; 2],
            sensor_size_m: [0.03; 2],
            spot_sigma_m: Some(1e-3),
            ..Default::default()
        };
        let camera = config.camera().expect("a camera");
        let mut model = TemplateModel::gaussian(&camera, 0.375e-3, 4e-3);
        model.vary(1, 4e-3);
        let mut model = model.filled();
        let n = model.n;
        let bump = |k: usize, shift: f64, width: f64| {
            let t = (k as f64 - 0.5 * n as f64 - shift) / width;
            (-0.5 * t * t).exp()
        };
        let weights = [[1.0, 0.3, -0.2], [0.4, -0.2, 0.3]];
        for c in 0..3 {
            for (j, i) in (0..n).flat_map(|j| (0..n).map(move |i| (j, i))) {
                model.coefficients[(c * n + j) * n + i] = weights[0][c] * bump(j, 0.0, 2.0) * bump(i, 0.0, 2.0)
                    + weights[1][c] * bump(j, 2.0, 2.5) * bump(i, -3.0, 1.8);
            }
        }
        let left = |count: usize| {
            let found = Separable::of(&camera, &model, count).expect("terms").template(&model);
            let pairs = || found.coefficients.iter().zip(&model.coefficients);
            let square = pairs().map(|(a, b)| (a - b).powi(2)).sum::<f64>();
            (square / pairs().map(|(_, b)| b * b).sum::<f64>()).sqrt()
        };
        assert!(left(1) > 0.1, "{}", left(1));
        assert!(left(2) < 1e-3, "{}", left(2));
        let shape = Separable::of(&camera, &model, 2)
            .and_then(|s| s.shape(&model))
            .expect("a shape");
        assert_eq!(shape.terms(), 2);
        assert!((shape.total([0.01, -0.004]) - 1.0).abs() < 1e-9);
    }
}
