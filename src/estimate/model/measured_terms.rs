//! The separable terms of a measured spot at one place: profiles along x, and factors along y with the weights that vary over the field.

use crate::estimate::model::svd_basis::Basis;
use crate::optics::spot::{KnotPlace, SpotShape};

/// The first and last columns and rows of a patch of pixels, the last left out.
pub(crate) type Span = [[usize; 2]; 2];

/// Columns and rows of a span.
#[inline(always)]
pub(crate) fn size([[left, right], [top, bottom]]: Span) -> [usize; 2] {
    [right - left, bottom - top]
}

/// A part of a spot that motion smears.
pub(crate) struct Part {
    /// Where, σ.
    pub u: [f64; 2],
    /// Of the spot's light.
    pub share: f64,
}

/// The terms of each part in turn. Products of derivatives are a factor along y times a profile along x, summed over the terms: a block of terms
/// with the weights, and one with the weights' derivatives along x.
#[derive(Default)]
pub(crate) struct MeasuredTerms {
    /// Terms of all parts.
    pub count: usize,
    /// Whether the weights' derivatives are zero.
    pub is_uniform: bool,
    /// Profiles along x, (3, count, columns): f″, f′, f.
    pub along_x: Vec<f64>,
    /// Factors of the light, (2, count, rows): with f; with f′ and f for its derivative along x.
    pub value: Vec<f64>,
    /// Of the light's derivative along y, (2, count, rows): as `value`.
    pub slope: Vec<f64>,
    /// Of its second derivative along x, (2, count, rows): with f″ and f′.
    pub xx: Vec<f64>,
    /// Of its second derivative along y, (count, rows): with f.
    pub yy: Vec<f64>,
    /// Of the pixels' edges.
    places: Vec<KnotPlace>,
}

impl MeasuredTerms {
    /// Evaluates the terms of all parts over a span, whose last columns may be beyond the sensor. Axes are in `sigma_m`, from `origin_m` on the
    /// sensor.
    #[inline(always)]
    pub fn collect(
        &mut self,
        shape: &SpotShape,
        (sigma_m, origin_m): (f64, [f64; 2]),
        axes: [&Basis; 2],
        parts: &[Part],
        span: Span,
    ) {
        let [columns, rows] = size(span);
        let count = parts.len() * shape.terms();
        self.count = count;
        self.is_uniform = shape.is_uniform();
        self.along_x.resize(3 * count * columns, 0.0);
        for factors in [&mut self.value, &mut self.slope, &mut self.xx] {
            factors.resize(2 * count * rows, 0.0);
        }
        self.yy.resize(count * rows, 0.0);
        let [per_sigma, per_sigma2] = [sigma_m, sigma_m * sigma_m];
        for (p, part) in parts.iter().enumerate() {
            let first = p * shape.terms();
            self.place(shape, axes[0], span[0], part.u[0], sigma_m);
            for k in 0..shape.terms() {
                let profile = shape.x_profile(k);
                let [f2, f1, f] = [first + k, count + first + k, 2 * count + first + k].map(|row| row * columns);
                let mut low = profile.at(self.places[0]);
                for c in 0..columns {
                    let high = profile.at(self.places[c + 1]);
                    self.along_x[f2 + c] = per_sigma2 * (high.slope - low.slope);
                    self.along_x[f1 + c] = per_sigma * (low.density - high.density);
                    self.along_x[f + c] = high.cumulative - low.cumulative;
                    low = high;
                }
            }
            self.place(shape, axes[1], span[1], part.u[1], sigma_m);
            let [x, y] = [0, 1].map(|k| origin_m[k] + part.u[k] * sigma_m);
            let weights = shape.weights_at(x, y);
            for (k, (w, du, dv)) in weights.enumerate() {
                let (w, du, dv) = (part.share * w, part.share * du * sigma_m, part.share * dv * sigma_m);
                let profile = shape.y_profile(k);
                let (first, second) = ((first + k) * rows, (count + first + k) * rows);
                let mut low = profile.at(self.places[0]);
                for r in 0..rows {
                    let high = profile.at(self.places[r + 1]);
                    let g = high.cumulative - low.cumulative;
                    let g1 = per_sigma * (low.density - high.density);
                    let g2 = per_sigma2 * (high.slope - low.slope);
                    self.value[first + r] = w * g;
                    self.value[second + r] = du * g;
                    self.slope[first + r] = w * g1 + dv * g;
                    self.slope[second + r] = du * g1;
                    self.xx[first + r] = w * g;
                    self.xx[second + r] = 2.0 * du * g;
                    // The weights' second derivatives are those of the field: far below the spot's.
                    self.yy[first + r] = w * g2 + 2.0 * dv * g1;
                    low = high;
                }
            }
        }
    }

    /// Places of the edges of the pixels from `first` to `last` against a spot at `u`; those beyond the sensor are the sensor's edge.
    #[inline(always)]
    fn place(&mut self, shape: &SpotShape, basis: &Basis, [first, last]: [usize; 2], u: f64, sigma_m: f64) {
        self.places.clear();
        for edge in first..=last {
            let t = (basis.edges[edge.min(basis.n)] - u) * sigma_m;
            self.places.push(shape.x_profile(0).place(t));
        }
    }
}
