//! The template as it is learned: bicubic splines for each component of the field.

use faer::Mat;
use rayon::prelude::*;

use super::pupil::{Aperture, Pupil};
use crate::optics::Camera;
use crate::optics::spot::{Field, FieldPolynomial, Template};

/// Unit-energy template Σ_c p_c(u, v)·T_c(x, y), p_0 = 1, the others products of Legendre polynomials.
#[derive(Clone, Debug)]
pub struct TemplateModel {
    pub field: Field,
    pub knot_m: f64,
    /// Splines a side of the first component; odd, so that one is in the middle.
    pub n: usize,
    /// Splines a side of the others, which lie within it; odd.
    pub inner: usize,
    pub degree: usize,
    /// First n², then inner² for each other component; rows in y.
    pub coefficients: Vec<f64>,
    /// The pupil that the coefficients are of, where that is learned instead of them.
    pub pupil: Option<Pupil>,
}

impl TemplateModel {
    /// The Gaussian that a camera assumes, on knots `knot_m` apart out to `radius_m`.
    pub fn gaussian(camera: &Camera, knot_m: f64, radius_m: f64) -> Self {
        let field = Field {
            half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
        };
        let s2 = camera.spot_sigma_m.powi(2);
        let density = |x: f64, y: f64| (-0.5 * (x * x + y * y) / s2).exp() / (std::f64::consts::TAU * s2);
        let template = Template::of_density(field, knot_m, radius_m, density);
        let coefficients = &template.components[0].coefficients;
        let total = coefficients.sum();
        Self {
            field,
            knot_m,
            n: coefficients.nrows(),
            inner: 0,
            degree: 0,
            coefficients: coefficients.iter().map(|c| c / total).collect(),
            pupil: None,
        }
    }

    /// Whether the shape may change over the field.
    pub fn varies(&self) -> bool {
        self.pupil.map_or(self.degree > 0, |pupil| pupil.varies)
    }

    /// The spot that a camera assumes, its own shape or a Gaussian, on the knots of another model.
    pub fn of_camera(camera: &Camera, like: &Self) -> Self {
        let at = |sensor_m: [f64; 2]| {
            let density = |x: f64, y: f64| match &camera.spot_shape {
                Some(shape) => shape.density(sensor_m, [x, y]),
                None => (-0.5 * (x.hypot(y) / camera.spot_sigma_at(sensor_m)).powi(2)).exp(),
            };
            // A little less, so that rounding adds no knot.
            let template = Template::of_density(like.field, like.knot_m, like.radius_m() * (1.0 - 1e-9), density);
            let mut values = template
                .components
                .into_iter()
                .flat_map(|c| c.coefficients)
                .collect::<Vec<f64>>();
            let total: f64 = values.iter().sum();
            values.iter_mut().for_each(|v| *v /= total);
            values
        };
        let is_uniform = match &camera.spot_shape {
            Some(shape) => shape.is_uniform(),
            None => camera.spot_growth == 0.0,
        };
        let half = like.field.half_sensor_m;
        like.over_field(|[u, v]| vec![at([u * half[0], v * half[1]])], !is_uniform)
            .remove(0)
    }

    /// The templates on the same knots whose first components would be `at` at each place of the field, projected on the Legendre
    /// polynomials by Gauss's quadrature, exact to the degree that a calibration may have.
    pub fn projected(&self, at: impl Fn([f64; 2]) -> Vec<Vec<f64>> + Sync) -> Vec<Self> {
        let n = self.n;
        let nodes: Vec<_> = NODES.iter().flat_map(|u| NODES.map(|v| (*u, v))).collect();
        let values: Vec<Vec<Vec<f64>>> = nodes.par_iter().map(|(u, v)| at([u.0, v.0])).collect();
        let count = values.first().map_or(0, Vec::len);
        let empty = Self {
            inner: n,
            degree: MOST_DEGREE,
            coefficients: vec![0.0; FieldPolynomial::length(MOST_DEGREE) * n * n],
            pupil: None,
            ..*self
        };
        let mut models = vec![empty; count];
        for (((u, wu), (v, wv)), values) in nodes.into_iter().zip(values) {
            for (model, values) in models.iter_mut().zip(values) {
                let blocks = model.coefficients.chunks_exact_mut(n * n);
                for (block, (i, j)) in blocks.zip(FieldPolynomial::powers()) {
                    let norm = 0.25 * f64::from((2 * i + 1) * (2 * j + 1));
                    let share = norm * wu * wv * legendre(i, u) * legendre(j, v);
                    block.iter_mut().zip(&values).for_each(|(b, value)| *b += share * value);
                }
            }
        }
        models
    }

    /// The template of a pupil on these knots.
    pub fn with_pupil(&self, pupil: Pupil) -> Self {
        let aperture = Aperture::unit();
        let at = |place: [f64; 2]| vec![aperture.coefficients(&pupil.local(place), self.n, self.knot_m)];
        Self {
            pupil: Some(pupil),
            ..self.over_field(at, pupil.varies).remove(0)
        }
    }

    /// Derivatives of a pupil's coefficients on these knots by each of its changes, as if it were the same change everywhere; zero by those
    /// that it may not have.
    pub fn pupil_changes(&self, pupil: &Pupil) -> Vec<Vec<f64>> {
        let at = |place: [f64; 2]| Aperture::unit().derivatives(pupil, place, self.n, self.knot_m);
        self.over_field(at, pupil.varies)
            .into_iter()
            .map(|model| model.coefficients)
            .collect()
    }

    /// The templates on the same knots that are `at` at each place of the field, or everywhere as in its middle.
    fn over_field(&self, at: impl Fn([f64; 2]) -> Vec<Vec<f64>> + Sync, varies: bool) -> Vec<Self> {
        if varies {
            return self.projected(at);
        }
        let uniform = |coefficients| Self {
            inner: 0,
            degree: 0,
            coefficients,
            pupil: None,
            ..*self
        };
        at([0.0; 2]).into_iter().map(uniform).collect()
    }

    pub fn radius_m(&self) -> f64 {
        0.5 * (self.n + 3) as f64 * self.knot_m
    }

    /// Components of the field, at least one.
    pub fn components(&self) -> usize {
        FieldPolynomial::length(self.degree)
    }

    /// Place of spline `k` of `n`, m from the spot's centre.
    pub fn knot(&self, k: usize) -> f64 {
        (k as f64 - 0.5 * (self.n - 1) as f64) * self.knot_m
    }

    /// Root mean square of p_c over the sensor.
    pub fn field_rms(&self, c: usize) -> f64 {
        let (i, j) = FieldPolynomial::powers().nth(c).unwrap_or_default();
        1.0 / f64::from((2 * i + 1) * (2 * j + 1)).sqrt()
    }

    /// Start of component `c` in the coefficients and its splines a side.
    pub fn block(&self, c: usize) -> (usize, usize) {
        match c {
            0 => (0, self.n),
            _ => (self.n * self.n + (c - 1) * self.inner * self.inner, self.inner),
        }
    }

    /// Adds components for a field polynomial of `degree`, zero as yet, out to `radius_m`.
    pub fn vary(&mut self, degree: usize, radius_m: f64) {
        let wanted = (2.0 * radius_m / self.knot_m) as usize;
        self.inner = (wanted | 1).min(self.n);
        self.degree = degree;
        let length = self.n * self.n + (self.components() - 1) * self.inner * self.inner;
        self.coefficients.resize(length, 0.0);
    }

    /// The same spot on `n` splines a side: the first component, or the pupil's.
    pub fn widened(&self, n: usize) -> Self {
        if let Some(pupil) = self.pupil {
            let wider = Self {
                n,
                coefficients: Vec::new(),
                ..*self
            };
            return wider.with_pupil(pupil);
        }
        let margin = (n - self.n) / 2;
        let mut coefficients = vec![0.0; n * n];
        for j in 0..self.n {
            let start = (j + margin) * n + margin;
            coefficients[start..start + self.n].copy_from_slice(&self.coefficients[j * self.n..(j + 1) * self.n]);
        }
        Self {
            n,
            inner: 0,
            degree: 0,
            coefficients,
            pupil: None,
            ..*self
        }
    }

    /// p_c at a place on the sensor, m.
    pub fn field_values(&self, sensor_m: [f64; 2]) -> Vec<f64> {
        let ([u, v], _) = self.field.at(sensor_m);
        let powers = FieldPolynomial::powers().take(self.components());
        powers.map(|(i, j)| legendre(i, u) * legendre(j, v)).collect()
    }

    /// Σ_c p_c·`coefficients`_c as n×n splines.
    pub fn local(&self, coefficients: &[f64], field_values: &[f64], out: &mut Vec<f64>) {
        let n = self.n;
        out.clear();
        out.extend_from_slice(&coefficients[..n * n]);
        let margin = (n - self.inner) / 2;
        // Row by row: all components at once do not stay in a cache.
        for (j, row) in out.chunks_exact_mut(n).skip(margin).take(self.inner).enumerate() {
            let row = &mut row[margin..margin + self.inner];
            let mut lines = field_values.iter().enumerate().skip(1).map(|(c, p)| {
                let (start, m) = self.block(c);
                (p, &coefficients[start + j * m..start + (j + 1) * m])
            });
            while let Some((p, line)) = lines.next() {
                // Two at a time: the row is read and written half as often.
                let (q, next) = lines.next().unwrap_or((&0.0, line));
                for ((o, v), w) in row.iter_mut().zip(line).zip(next) {
                    *o += p * v + q * w;
                }
            }
        }
    }

    /// The adjoint of [`Self::local`]: adds an n×n gradient to that of the coefficients.
    pub fn local_adjoint(&self, gradient: &[f64], field_values: &[f64], out: &mut [f64]) {
        let n = self.n;
        for (o, g) in out[..n * n].iter_mut().zip(gradient) {
            *o += g;
        }
        let margin = (n - self.inner) / 2;
        for (c, p) in field_values.iter().enumerate().skip(1) {
            let (start, m) = self.block(c);
            for (j, line) in out[start..start + m * m].chunks_exact_mut(m).enumerate() {
                let from = (j + margin) * n + margin;
                for (o, v) in line.iter_mut().zip(&gradient[from..from + m]) {
                    *o += p * v;
                }
            }
        }
    }

    /// Makes the light 1 everywhere; returns the factor on the energy of spots at places with the given field values.
    pub fn normalise(&mut self) -> impl Fn(&[f64]) -> f64 + use<> {
        let light: Vec<f64> = (0..self.components())
            .map(|c| {
                let (start, m) = self.block(c);
                self.coefficients[start..start + m * m].iter().sum()
            })
            .collect();
        let (n, margin) = (self.n, (self.n - self.inner) / 2);
        // A change over the field carries no light: its share of the first component is taken out.
        for c in 1..light.len() {
            let (start, m) = self.block(c);
            let (first, change) = self.coefficients.split_at_mut(start);
            let within: f64 = (0..m * m).map(|k| first[(k / m + margin) * n + k % m + margin]).sum();
            for k in 0..m * m {
                change[k] -= light[c] / within * first[(k / m + margin) * n + k % m + margin];
            }
        }
        self.coefficients.iter_mut().for_each(|k| *k /= light[0]);
        move |p: &[f64]| light.iter().zip(p).map(|(l, p)| l * p).sum::<f64>().max(0.1 * light[0])
    }

    /// Coefficients of component `c` on all knots.
    pub fn component(&self, c: usize) -> Mat<f64> {
        let (start, m) = self.block(c);
        let margin = (self.n - m) / 2;
        let mut out = Mat::zeros(self.n, self.n);
        for (k, value) in self.coefficients[start..start + m * m].iter().enumerate() {
            out[(k / m + margin, k % m + margin)] = *value;
        }
        out
    }

    /// The same with all components on all knots.
    pub fn filled(&self) -> Self {
        let n = self.n;
        let mut coefficients = Vec::with_capacity(self.components() * n * n);
        for c in 0..self.components() {
            let component = self.component(c);
            (0..n).for_each(|j| coefficients.extend((0..n).map(|i| component[(j, i)])));
        }
        Self {
            inner: n,
            coefficients,
            ..*self
        }
    }

    /// Monomials of p_c.
    pub fn field_polynomial(&self, c: usize) -> Vec<f64> {
        let powers = || FieldPolynomial::powers().take(self.components());
        let (i, j) = powers().nth(c).unwrap_or_default();
        let (a, b) = (legendre_monomials(i), legendre_monomials(j));
        powers().map(|(k, l)| a[k as usize] * b[l as usize]).collect()
    }
}

/// Highest degree of the field's polynomials.
pub const MOST_DEGREE: usize = 6;

/// Gauss–Legendre nodes and weights of order 7 on [−1, 1] (Abramowitz and Stegun, 1964, table 25.4).
const NODES: [(f64, f64); 7] = [
    (0.0, 0.417_959_183_673_469),
    (0.405_845_151_377_397, 0.381_830_050_505_119),
    (-0.405_845_151_377_397, 0.381_830_050_505_119),
    (0.741_531_185_599_394, 0.279_705_391_489_277),
    (-0.741_531_185_599_394, 0.279_705_391_489_277),
    (0.949_107_912_342_759, 0.129_484_966_168_870),
    (-0.949_107_912_342_759, 0.129_484_966_168_870),
];

/// Coefficients of the Legendre polynomial of degree `n` (Abramowitz and Stegun, 1964, table 22.9).
fn legendre_monomials(n: i32) -> [f64; MOST_DEGREE + 1] {
    match n {
        0 => [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        1 => [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        2 => [-0.5, 0.0, 1.5, 0.0, 0.0, 0.0, 0.0],
        3 => [0.0, -1.5, 0.0, 2.5, 0.0, 0.0, 0.0],
        4 => [0.375, 0.0, -3.75, 0.0, 4.375, 0.0, 0.0],
        5 => [0.0, 1.875, 0.0, -8.75, 0.0, 7.875, 0.0],
        _ => [-0.3125, 0.0, 6.5625, 0.0, -19.6875, 0.0, 14.4375],
    }
}

fn legendre(n: i32, t: f64) -> f64 {
    legendre_monomials(n).iter().rev().fold(0.0, |sum, c| sum * t + c)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics;

    #[test]
    fn a_template_follows_its_pupil_over_the_field() {
        let config = optics::Config {
            pixels: [40; 2],
            sensor_size_m: [0.03; 2],
            spot_sigma_m: Some(1e-3),
            ..Default::default()
        };
        let camera = config.camera().expect("a camera");
        let like = TemplateModel::gaussian(&camera, 0.3e-3, 9e-3);
        let mut pupil = Pupil {
            varies: true,
            ..Pupil::of_camera(&camera)
        };
        // Coma along x that grows along u.
        pupil.parameters[Pupil::range(5)][1] = 0.12;
        let (model, changes) = (like.with_pupil(pupil), like.pupil_changes(&pupil));
        let at = [0.8 * 0.015, -0.3 * 0.015];
        let (values, mut local) = (model.field_values(at), Vec::new());
        let exact = |pupil: &Pupil| Aperture::unit().coefficients(&pupil.local([0.8, -0.3]), like.n, like.knot_m);
        let largest = |v: &[f64]| v.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
        let difference = |a: &[f64], b: &[f64]| largest(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>());
        model.local(&model.coefficients, &values, &mut local);
        let expected = exact(&pupil);
        assert!(difference(&local, &expected) < 0.02 * largest(&expected));
        // What one parameter changes there.
        let step = 1e-4;
        let mut moved = pupil;
        moved.parameters[Pupil::range(5)][1] += step;
        let slope: Vec<f64> = exact(&moved)
            .iter()
            .zip(&expected)
            .map(|(a, b)| (a - b) / step)
            .collect();
        model.local(&changes[5], &values, &mut local);
        local.iter_mut().for_each(|v| *v *= Pupil::factors([0.8, -0.3])[1]);
        assert!(difference(&local, &slope) < 0.05 * largest(&slope));
    }
}
