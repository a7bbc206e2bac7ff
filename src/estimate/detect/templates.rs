//! Unit-norm spots on a grid along one axis of the matched filter.

use crate::estimate::dense_linalg::{combine, dot};
use crate::estimate::model::svd_basis::Basis;

/// Grid spacing, σ: a spot half-way between grid points loses 3 % of its response. Half the spacing has four times the points.
const SPACING: f64 = 0.5;
/// Half-width of a template, σ: the rest holds 1e-5 of a spot's square.
const REACH: f64 = 3.0;
/// Points whose responses are summed together where templates are short: more waste sums over what is zero in most of them.
const BLOCK: usize = 16;

/// First and last, the last left out.
type Range = [usize; 2];

/// The templates of one axis.
pub(super) struct Templates {
    /// Positions, σ.
    pub points: Vec<f64>,
    /// Norms of the spots before they became templates.
    pub norms: Vec<f64>,
    /// Numbers in a row of `values`: a multiple of four.
    width: usize,
    /// (coefficients, points).
    values: Vec<f64>,
    /// Coefficients outside which a point's template is zero.
    spans: Vec<Range>,
    /// Points that are summed together, with what their spans cover.
    blocks: Vec<[Range; 2]>,
}

impl Templates {
    pub fn new(basis: &Basis) -> Self {
        // Centres up to half a σ outside; farther out only a fit can place them.
        // Within a pixel much wider than the spot the response is constant: a grid of σ would only cost memory.
        let spacing = SPACING.max(0.25 * basis.pitch());
        let (lo, hi) = (basis.edges[0] - spacing, basis.edges[basis.n] + spacing);
        let count = ((hi - lo) / spacing).ceil() as usize + 1;
        let points: Vec<f64> = (0..count)
            .map(|k| lo + (hi - lo) * k as f64 / (count - 1) as f64)
            .collect();
        let width = count.next_multiple_of(4);
        let mut values = vec![0.0; basis.stride * width];
        let (mut norms, mut spans) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let (mut scratch, mut profile) = (vec![0.0; 3 * basis.n], vec![0.0; 3 * basis.stride]);
        for (k, point) in points.iter().enumerate() {
            let span = basis.profile(*point, 1.0, REACH, basis.stride, &mut scratch, &mut profile);
            let profile = &profile[..basis.stride];
            let norm = dot(profile, profile).sqrt().max(1e-12);
            for (value, f) in values[k..].iter_mut().step_by(width).zip(profile) {
                *value = f / norm;
            }
            norms.push(norm);
            spans.push([span.start, span.end]);
        }
        let block = if basis.is_pixels { BLOCK } else { width };
        let blocks = (0..width)
            .step_by(block)
            .map(|first| {
                let covered = &spans[first.min(count)..count.min(first + block)];
                let covered = covered.iter().filter(|[lo, hi]| lo < hi);
                let span = covered
                    .copied()
                    .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
                    .unwrap_or_default();
                [[first, width.min(first + block)], span]
            })
            .collect();
        Self {
            points,
            norms,
            width,
            values,
            spans,
            blocks,
        }
    }

    /// The same with each number squared.
    pub fn squared(&self) -> Self {
        Self {
            values: self.values.iter().map(|v| v * v).collect(),
            points: self.points.clone(),
            norms: self.norms.clone(),
            spans: self.spans.clone(),
            blocks: self.blocks.clone(),
            ..*self
        }
    }

    /// Sum of the rows of a matrix (my, mx), weighted by the template at point `k`.
    #[inline(always)]
    pub fn sum_rows(&self, k: usize, matrix: &[f64], [mx, my]: [usize; 2], out: &mut Vec<f64>) {
        let [lo, hi] = self.spans[k].map(|c| c.min(my));
        out.resize(mx, 0.0);
        if lo == hi {
            return out.fill(0.0);
        }
        let weights = &self.values[lo * self.width + k..(hi - 1) * self.width + k + 1];
        combine([weights], self.width, &matrix[lo * mx..], mx, mx, out);
    }

    /// Products of all templates with a profile; behind the last point, zeros.
    #[inline(always)]
    pub fn respond(&self, profile: &[f64], out: &mut Vec<f64>) {
        out.resize(self.width, 0.0);
        for [[first, last], span] in &self.blocks {
            let [lo, hi] = span.map(|c| c.min(profile.len()));
            let rows = &self.values[(lo * self.width + first).min(self.values.len())..];
            combine(
                [&profile[lo..hi]],
                1,
                rows,
                self.width,
                last - first,
                &mut out[*first..*last],
            );
        }
    }
}
