//! Masked pixels: an exact downdate of the normal equations, whatever value the pixels were filled with.

use std::collections::BTreeSet;
use std::ops::Range;

use crate::estimate::dense_linalg::{axpy, combine, dot};
use crate::estimate::model::svd_basis::Basis;

/// Mean length of a run from which sums over runs are cheaper than sums over pixels.
const LONG: usize = 4;
/// Fewer masked pixels than this are downdated one by one.
const MANY: usize = 64;
/// Conjugate gradients stop when an iteration changes the deviance by less than this, far below a source's penalty, or after so many
/// iterations, which bounds the time of a frame that is nearly all masked.
const SMALL: f64 = 1e-3;
const ROUNDS: usize = 500;

/// A masked pixel and the value it was filled with.
#[derive(Clone, Copy)]
pub(crate) struct MaskedPixel {
    pub x: usize,
    pub y: usize,
    pub value: f64,
}

/// Adjacent masked pixels of one row.
#[derive(Clone)]
pub(crate) struct Run {
    pub y: usize,
    pub x: Range<usize>,
    first: usize,
}

/// A frame's masked pixels, row by row.
#[derive(Clone, Default)]
pub(crate) struct MaskedPixels {
    pub pixels: Vec<MaskedPixel>,
    runs: Vec<Run>,
    /// Distinct columns and rows of the masked pixels.
    pub lines: [Vec<usize>; 2],
    /// Fill values less what the bases hold at the pixels.
    fill_excess: Vec<f64>,
}

impl MaskedPixels {
    /// Loads the masked pixels of a frame with coefficients `z`, (my, mx); where the frame is compressed both are changed so that the
    /// fill lies within the bases.
    #[inline(always)]
    pub fn load(
        &mut self,
        pixels: impl Iterator<Item = MaskedPixel>,
        z: &mut [f64],
        mx: usize,
        bx: &Basis,
        by: &Basis,
    ) {
        self.clear();
        self.pixels.extend(pixels);
        if self.pixels.is_empty() {
            return;
        }
        self.pixels.sort_unstable_by_key(|b| (b.y, b.x));
        for (k, b) in self.pixels.iter().enumerate() {
            match self.runs.last_mut() {
                Some(run) if run.y == b.y && run.x.end == b.x => run.x.end += 1,
                _ => self.runs.push(Run {
                    y: b.y,
                    x: b.x..b.x + 1,
                    first: k,
                }),
            }
        }
        let columns: BTreeSet<usize> = self.pixels.iter().map(|b| b.x).collect();
        self.lines = [
            columns.into_iter().collect(),
            self.runs.chunk_by(|a, b| a.y == b.y).map(|row| row[0].y).collect(),
        ];
        self.fill_excess.resize(self.pixels.len(), 0.0);
        if !(bx.is_pixels && by.is_pixels) {
            self.fill_consistently(z, mx, [bx, by]);
        }
    }

    pub fn clear(&mut self) {
        self.pixels.clear();
        self.runs.clear();
        self.lines = Default::default();
        self.fill_excess.clear();
    }

    pub fn len(&self) -> usize {
        self.pixels.len()
    }

    pub fn is_empty(&self) -> bool {
        self.pixels.is_empty()
    }

    /// Whether sums over runs cost less than sums over pixels.
    fn prefers_runs(&self) -> bool {
        self.len() >= MANY && self.len() >= LONG * self.runs.len()
    }

    /// The runs, if sums over runs are cheaper; otherwise none.
    pub fn runs(&self) -> &[Run] {
        if self.prefers_runs() { &self.runs } else { &[] }
    }

    /// The single pixels, if sums over pixels are cheaper; otherwise none.
    pub fn scattered(&self) -> &[MaskedPixel] {
        if self.prefers_runs() { &[] } else { &self.pixels }
    }

    /// Multiplications of [`MaskedPixels::project_out`].
    pub fn project_out_cost(&self, mx: usize, my: usize) -> f64 {
        (2 * mx * (self.len() + my * self.lines[1].len())) as f64
    }

    /// Removes the masked pixels' part from a matrix (my, mx): M − UᵦᵀUᵦM. From a frame's residual (`is_residual`) the fill values are
    /// removed too. Returns the removed square.
    #[inline(always)]
    pub fn project_out(
        &self,
        matrix: &mut [f64],
        mx: usize,
        [bx, by]: [&Basis; 2],
        is_residual: bool,
        scratch: &mut Vec<f64>,
    ) -> f64 {
        let mut square = 0.0;
        if bx.is_pixels && by.is_pixels {
            for b in &self.pixels {
                let value = std::mem::take(&mut matrix[b.y * mx + b.x]);
                square += value * value;
            }
            return square;
        }
        let (size, my) = (matrix.len(), matrix.len() / mx);
        scratch.clear();
        scratch.extend_from_slice(matrix);
        scratch.resize(size + 3 * mx + bx.width(), 0.0);
        let (whole, rest) = scratch.split_at_mut(size);
        let (row, rest) = rest.split_at_mut(mx);
        let (part, rest) = rest.split_at_mut(mx);
        let (sum, held) = rest.split_at_mut(mx);
        for line in self.runs.chunk_by(|a, b| a.y == b.y) {
            let uy = &by.row(line[0].y)[..my];
            combine([uy], 1, whole, mx, mx, row);
            sum.fill(0.0);
            for run in line {
                let held = run.evaluate(row, bx, held);
                if is_residual {
                    axpy(1.0, &self.fill_excess[run.first..], held);
                }
                square += dot(held, held);
                combine([&*held], 1, &bx.rows()[run.x.start * bx.stride..], bx.stride, mx, part);
                axpy(1.0, part, sum);
            }
            for (u, out) in uy.iter().zip(matrix.chunks_exact_mut(mx)) {
                axpy(-u, sum, out);
            }
        }
        square
    }

    /// Sets `fill_excess`: the fill values less what `z` holds at the pixels.
    #[inline(always)]
    fn record_fill_excess(&mut self, z: &[f64], mx: usize, [bx, by]: [&Basis; 2]) {
        let my = z.len() / mx;
        let (mut row, mut held) = (vec![0.0; mx], vec![0.0; bx.width()]);
        for run in &self.runs {
            combine([&by.row(run.y)[..my]], 1, z, mx, mx, &mut row);
            let held = run.evaluate(&row, bx, &mut held);
            for (k, shown) in held.iter().enumerate() {
                self.fill_excess[run.first + k] = self.pixels[run.first + k].value - shown;
            }
        }
    }

    /// Fills the pixels with the value that the bases predict there from the usable pixels, and updates `z`, (my, mx): then no part of
    /// the fill lies outside the bases, where it would count as noise.
    ///
    /// The usable pixels' coefficients solve (I − UᵦᵀUᵦ) z = Uᵀ y over them; conjugate gradients (Hestenes and Stiefel, 1952).
    #[inline(always)]
    fn fill_consistently(&mut self, z: &mut [f64], mx: usize, axes: [&Basis; 2]) {
        let mut scratch = Vec::new();
        self.record_fill_excess(z, mx, axes);
        let mut usable = z.to_vec();
        self.project_out(&mut usable, mx, axes, true, &mut scratch);
        let mut change = z.to_vec();
        self.project_out(&mut change, mx, axes, false, &mut scratch);
        let mut left: Vec<f64> = usable.iter().zip(&change).map(|(u, c)| u - c).collect();
        let mut direction = left.clone();
        let mut square = dot(&left, &left);
        for _ in 0..ROUNDS {
            change.clone_from(&direction);
            self.project_out(&mut change, mx, axes, false, &mut scratch);
            let curvature = dot(&direction, &change);
            if !(curvature > 1e-12 * dot(&direction, &direction)) {
                break;
            }
            let step = square / curvature;
            axpy(step, &direction, z);
            axpy(-step, &change, &mut left);
            let before = std::mem::replace(&mut square, dot(&left, &left));
            if step * before < SMALL {
                break;
            }
            for (d, l) in direction.iter_mut().zip(&left) {
                *d = l + square / before * *d;
            }
        }
        self.record_fill_excess(z, mx, axes);
        for (b, fill_excess) in self.pixels.iter_mut().zip(&self.fill_excess) {
            b.value -= fill_excess;
        }
        // Consistent with the fill as it is now, whether or not the iteration converged.
        change.copy_from_slice(z);
        self.project_out(&mut change, mx, axes, false, &mut scratch);
        for ((z, c), u) in z.iter_mut().zip(&change).zip(&usable) {
            *z += u - c;
        }
        self.record_fill_excess(z, mx, axes);
    }
}

impl Run {
    /// Values of a row of coefficients, (mx), at the run's pixels; `out` has room for a row of the frame.
    #[inline(always)]
    fn evaluate<'a>(&self, row: &[f64], bx: &Basis, out: &'a mut [f64]) -> &'a mut [f64] {
        let length = self.x.len();
        let columns = bx.columns_from(self.x.start);
        combine([row], 1, columns, bx.width(), length.next_multiple_of(4), out);
        &mut out[..length]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::Axis;

    #[test]
    fn projecting_out_agrees_with_the_definition() {
        let b = Basis::new(&Axis::centred(20, 0.02), 0.004);
        let m = b.columns().next_multiple_of(4).min(b.stride);
        let mut z: Vec<f64> = (0..m * m).map(|k| ((k * 37 % 101) as f64 / 50.0) - 1.0).collect();
        let blob = (0..6).flat_map(|y| (0..5).map(move |x| (x + 7, y + 9)));
        let pixels: Vec<_> = blob.chain([(0, 0), (19, 3), (4, 19)]).collect();
        let filled = pixels.iter().map(|&(x, y)| MaskedPixel { x, y, value: 40.0 });
        let mut bad = MaskedPixels::default();
        bad.load(filled, &mut z, m, &b, &b);
        let mut expected = z.clone();
        let mut square = 0.0;
        for &(x, y) in &pixels {
            let (ux, uy) = (&b.row(x)[..m], &b.row(y)[..m]);
            let held: f64 = (0..m * m).map(|k| uy[k / m] * z[k] * ux[k % m]).sum();
            square += held * held;
            for (k, e) in expected.iter_mut().enumerate() {
                *e -= held * uy[k / m] * ux[k % m];
            }
        }
        let mut taken = z.clone();
        let found = bad.project_out(&mut taken, m, [&b, &b], false, &mut Vec::new());
        assert!((found - square).abs() < 1e-9 * square, "{found} {square}");
        for (t, e) in taken.iter().zip(&expected) {
            assert!((t - e).abs() < 1e-9, "{t} {e}");
        }
    }
}
