//! From a sampled template to separable terms.

use faer::Mat;
use ndarray::Array2;

use super::field::{Field, FieldPolynomial};
use super::profile::Profile;
use super::shape::{SpotShape, Term};

/// One component of a template: p(u, v)·T(x, y) with T = Σ_ji c_ji·B₃((y − t_j)/h)·B₃((x − t_i)/h)/h².
#[derive(Clone, Debug)]
pub struct Component {
    pub field: FieldPolynomial,
    /// c_ji, dimensionless, rows from −R up in y, columns in x; square. They add up to the component's light.
    pub coefficients: Array2<f64>,
}

/// A spot as bicubic splines, before it is made separable. The first component holds the light; the others say how it changes
/// over the field.
#[derive(Clone, Debug)]
pub struct Template {
    pub field: Field,
    /// Distance of the knots, m.
    pub knot_m: f64,
    /// At least one; all of the same size.
    pub components: Vec<Component>,
}

impl Template {
    /// Interpolates a density, 1/m² on any scale, of x and y from the spot's centre, m, that is negligible beyond `radius_m`, at
    /// knots `knot_m` apart. It should be smooth on that scale.
    pub fn of_density(field: Field, knot_m: f64, radius_m: f64, density: impl Fn(f64, f64) -> f64) -> Self {
        let n = (2 * (radius_m / knot_m).ceil() as usize + 1).saturating_sub(4).max(5);
        let at = |k: usize| (k as f64 - 0.5 * (n - 1) as f64) * knot_m;
        Self {
            field,
            knot_m,
            components: vec![Component {
                field: FieldPolynomial::constant(1.0),
                coefficients: Self::interpolated(Array2::from_shape_fn((n, n), |(j, i)| density(at(i), at(j)))),
            }],
        }
    }

    /// Coefficients of the splines that have these values at the knots.
    pub fn interpolated(mut values: Array2<f64>) -> Array2<f64> {
        for mut line in values.rows_mut() {
            interpolate(&mut line);
        }
        for mut line in values.columns_mut() {
            interpolate(&mut line);
        }
        values
    }
}

/// Values at the knots to coefficients of the interpolating cardinal cubic spline: (c_{i−1} + 4c_i + c_{i+1})/6 = f_i, zero outside
/// (Thomas's algorithm).
fn interpolate(line: &mut ndarray::ArrayViewMut1<f64>) {
    let n = line.len();
    let mut upper = vec![0.0; n];
    for i in 0..n {
        let (before, above) = match i {
            0 => (0.0, 0.0),
            _ => (line[i - 1], upper[i - 1]),
        };
        let pivot = 4.0 - above;
        upper[i] = 1.0 / pivot;
        line[i] = (6.0 * line[i] - before) / pivot;
    }
    for i in (0..n.saturating_sub(1)).rev() {
        line[i] -= upper[i] * line[i + 1];
    }
}

/// Digits of a profile's coefficients after the point, in units of the largest: what rounding leaves out, 10⁻⁸ of the peak, is far
/// below what any calibration knows, and the file stays readable.
const GRAIN: f64 = 1e-8;

impl SpotShape {
    /// The fewest terms that leave out less than `tolerance` of the template, as a share of its root mean square over the pixels
    /// and the field; at most [`Self::MOST_TERMS`]. The light is normalised to 1 at every place. None where the template has no light.
    ///
    /// Singular values of B-spline coefficients stand for those of the function: the basis is well conditioned (de Boor, 1978,
    /// ch. XI), and K is at most one term too large for it.
    pub fn from_template(template: &Template, tolerance: f64) -> Option<Self> {
        let light = template.components.first()?.coefficients.sum();
        if !(light.is_finite() && light > 0.0) {
            return None;
        }
        let mut found: Vec<(f64, _)> = Vec::new();
        for component in &template.components {
            let share = component.field.rms();
            let (ny, nx) = component.coefficients.dim();
            let matrix = Mat::from_fn(ny, nx, |j, i| component.coefficients[(j, i)] / light);
            let svd = matrix.thin_svd().ok()?;
            let s = svd.S().column_vector();
            for k in (0..s.nrows()).filter(|k| s[*k] > 0.0) {
                let column = |m: faer::MatRef<'_, f64>| (0..m.nrows()).map(|i| m[(i, k)]).collect::<Vec<f64>>();
                let weight = FieldPolynomial(component.field.0.iter().map(|p| p * s[k]).collect());
                found.push((s[k] * share, (weight, column(svd.U()), column(svd.V()))));
            }
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let square = |terms: &[(f64, _)]| terms.iter().map(|t| t.0 * t.0).sum::<f64>();
        let all = square(&found);
        let enough = |k: &usize| square(&found[*k..]) <= (tolerance * tolerance) * all;
        let count = (1..=found.len()).find(enough)?.min(Self::MOST_TERMS);
        let strongest = found.into_iter().take(count).map(|(_, term)| term);
        Self::from_terms(template.field, template.knot_m, strongest)
    }

    /// From terms' weights and coefficients along y and x, all of the same length on knots `knot_m` apart. The light is normalised to 1 at
    /// every place. None where they have no light.
    pub fn from_terms(
        field: Field,
        knot_m: f64,
        terms: impl IntoIterator<Item = (FieldPolynomial, Vec<f64>, Vec<f64>)>,
    ) -> Option<Self> {
        let rounded = |values: Vec<f64>| {
            let largest = values.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
            let values = values.iter().map(|v| (v / largest / GRAIN).round() * GRAIN).collect();
            (largest, Profile::new(knot_m, values))
        };
        let mut terms: Vec<Term> = terms
            .into_iter()
            .map(|(weight, y, x)| {
                let ((by, y), (bx, x)) = (rounded(y), rounded(x));
                let weight = FieldPolynomial(weight.0.iter().map(|w| w * bx * by).collect());
                Term { weight, x, y }
            })
            .collect();
        let light = |t: &Term| t.weight.0.first().copied().unwrap_or(0.0) * t.x.total() * t.y.total();
        terms.sort_by(|a, b| light(b).total_cmp(&light(a)));
        let total: f64 = terms.iter().map(light).sum();
        if !(total.is_finite() && total > 0.0) {
            return None;
        }
        normalise(&mut terms);
        Some(Self {
            field,
            terms,
            beyond: None,
        })
    }
}

/// Makes Σ_k w_k·A_k·B_k = 1 as a polynomial, A and B the profiles' integrals: what the other terms add or take is taken from the
/// first, the strongest.
fn normalise(terms: &mut [Term]) {
    let length = terms.iter().map(|t| t.weight.0.len()).max().unwrap_or(1);
    let light = |term: &Term| term.x.total() * term.y.total();
    let sum = |p: usize| {
        let of = |t: &Term| t.weight.0.get(p).copied().unwrap_or(0.0) * light(t);
        terms.iter().map(of).sum::<f64>()
    };
    let sums: Vec<f64> = (0..length).map(sum).collect();
    for term in terms.iter_mut() {
        term.weight.0.iter_mut().for_each(|w| *w /= sums[0]);
    }
    let first = &mut terms[0];
    let own = light(first);
    first.weight.0.resize(length, 0.0);
    for (weight, sum) in first.weight.0.iter_mut().zip(&sums).skip(1) {
        *weight -= sum / sums[0] / own;
    }
    for term in terms.iter_mut() {
        while term.weight.0.len() > 1 && term.weight.0.last() == Some(&0.0) {
            term.weight.0.pop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slanted spot whose slant grows along u.
    fn template() -> Template {
        let field = Field {
            half_sensor_m: [2.0, 1.0],
        };
        let slanted = |x: f64, y: f64, s: f64| (-0.5 * (x * x + y * y + s * x * y)).exp();
        let mut template = Template::of_density(field, 0.25, 7.0, |x, y| slanted(x, y, 0.3));
        let mut other = Template::of_density(field, 0.25, 7.0, |x, y| {
            0.1 * x * slanted(x, y, 0.2) + 0.05 * slanted(x, y, 0.0)
        });
        let mut change = other.components.remove(0);
        change.field = FieldPolynomial(vec![0.0, 1.0]);
        template.components.push(change);
        template
    }

    #[test]
    fn more_terms_leave_out_less_and_the_light_is_one_everywhere() {
        let exact = SpotShape::from_template(&template(), 1e-7).unwrap();
        let error = |shape: &SpotShape, at: [f64; 2]| {
            let steps = || (-12..=12).map(|k| 0.4 * f64::from(k));
            let offsets = steps().flat_map(|x| steps().map(move |y| [x, y]));
            let pairs: Vec<_> = offsets.map(|o| (shape.density(at, o), exact.density(at, o))).collect();
            let rms = |f: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(|p| f(p).powi(2)).sum::<f64>().sqrt();
            rms(&|p| p.0 - p.1) / rms(&|p| p.1)
        };
        let mut terms = 0;
        for tolerance in [0.1, 1e-2, 1e-3, 1e-4] {
            let shape = SpotShape::from_template(&template(), tolerance).unwrap();
            assert!(shape.terms() > terms, "{tolerance}");
            terms = shape.terms();
            for at in [[0.0, 0.0], [1.5, 0.5], [-2.0, -1.0]] {
                assert!((shape.total(at) - 1.0).abs() < 1e-12, "{}", shape.total(at));
                // The tolerance is a mean over the field and of the coefficients, not of the density.
                assert!(
                    error(&shape, at) < 3.0 * tolerance,
                    "{tolerance} {at:?}: {}",
                    error(&shape, at)
                );
            }
        }
        assert!(!exact.is_uniform() && terms < exact.terms());
    }

    #[test]
    fn weights_have_their_derivatives() {
        let shape = SpotShape::from_template(&template(), 1e-3).unwrap();
        let h = 1e-6;
        let value = |u, v| shape.weights_at(u, v).map(|w| w.0).collect::<Vec<_>>();
        for (k, (_, du, dv)) in shape.weights_at(0.7, -0.4).enumerate() {
            let along_u = (value(0.7 + h, -0.4)[k] - value(0.7 - h, -0.4)[k]) / (2.0 * h);
            let along_v = (value(0.7, -0.4 + h)[k] - value(0.7, -0.4 - h)[k]) / (2.0 * h);
            assert!((du - along_u).abs() < 1e-7 && (dv - along_v).abs() < 1e-7);
        }
    }
}
