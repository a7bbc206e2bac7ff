//! The linear part of the fit: amplitudes at given positions by least squares, with a lower bound on those of sources.

use crate::estimate::dense_linalg::{axpy, cholesky, solve};
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::separable_model::{SLOPES, SeparableModel};

/// Lower bound of a source's amplitude in standard deviations of a lone one's: at zero its position would have no gradient.
const AMPLITUDE_FLOOR: f64 = 0.05;

/// The least-squares problem of the amplitudes.
#[derive(Default)]
pub(crate) struct AmplitudeSystem {
    /// Inner products of the components, lower triangle, and of each with the frame.
    gram: Vec<f64>,
    rhs: Vec<f64>,
    /// Components that are not fixed at their bound (the active set of the bounds).
    is_free: Vec<bool>,
    /// The Cholesky factor and the solution over the free components.
    factor: Vec<f64>,
    solution: Vec<f64>,
    /// The components' values at a masked pixel.
    values: Vec<f64>,
}

impl AmplitudeSystem {
    /// Which components of the last solution are not fixed at their bound.
    pub fn is_free(&self) -> &[bool] {
        &self.is_free
    }
}

/// Solves the amplitudes of a model; sources that fall below the bound are fixed at it.
#[inline(always)]
pub(crate) fn solve_amplitudes(
    model: &mut SeparableModel,
    compressed: &CompressedFrame,
    system: &mut AmplitudeSystem,
    strip: &mut Vec<f64>,
) {
    let n = model.sources.len();
    let components = model.components();
    if components == 0 {
        return;
    }
    let AmplitudeSystem {
        gram,
        rhs,
        is_free,
        factor,
        solution,
        values,
    } = system;
    gram.resize(components * components, 0.0);
    rhs.resize(components, 0.0);
    for i in 0..components {
        for j in 0..=i {
            gram[i * components + j] = model.inner_product(i, [0, 0], j, [0, 0], &compressed.weights, strip);
        }
        rhs[i] = model.project_value(i, compressed.weighted_coefficients(), strip);
        if let Some(power) = model.sources.get(i).and_then(|s| s.power) {
            gram[i * components + i] += power.precision;
            rhs[i] += power.precision * power.mean;
        }
    }
    let runs = compressed.masked.runs();
    for i in 0..if runs.is_empty() { 0 } else { components } {
        for j in 0..=i {
            gram[i * components + j] -= model.gram_block_over_runs(i, j, runs, strip)[8];
        }
    }
    for bad in compressed.masked.scattered() {
        values.resize(components, 0.0);
        for i in 0..components {
            values[i] = model.derivatives_at(i, [bad.x, bad.y], SLOPES)[0];
        }
        for i in 0..components {
            if values[i] != 0.0 {
                let s = -values[i];
                axpy(s, &values[..i + 1], &mut gram[i * components..i * components + i + 1]);
            }
        }
    }
    is_free.clear();
    is_free.resize(components, true);
    solution.resize(components.max(solution.len()), 0.0);
    let floor = |i: usize| AMPLITUDE_FLOOR / gram[i * components + i].max(1e-30).sqrt();
    loop {
        let mut order = 0;
        factor.resize(factor.len().max(components * components), 0.0);
        let size = is_free.iter().filter(|a| **a).count();
        for i in (0..components).filter(|&i| is_free[i]) {
            let mut b = rhs[i];
            for k in (0..components).filter(|&k| !is_free[k]) {
                b -= gram[i.max(k) * components + i.min(k)] * floor(k);
            }
            solution[order] = b;
            for (column, j) in (0..=i).filter(|&j| is_free[j]).enumerate() {
                factor[column * size + order] = gram[i * components + j];
            }
            factor[order * size + order] *= 1.0 + 1e-13;
            order += 1;
        }
        if size > 0 {
            let mut ridge = 1e-12;
            while !cholesky(&mut factor[..size * size], size) {
                let mut row = 0;
                for i in (0..components).filter(|&i| is_free[i]) {
                    for (column, j) in (0..=i).filter(|&j| is_free[j]).enumerate() {
                        factor[column * size + row] = gram[i * components + j];
                    }
                    factor[row * size + row] = gram[i * components + i].max(1e-30) * (1.0 + ridge);
                    row += 1;
                }
                ridge *= 10.0;
            }
            solve(factor, size, solution);
        }
        let mut row = 0;
        let mut clipped = false;
        for i in 0..components {
            if !is_free[i] {
                if i < n {
                    model.sources[i].a = floor(i);
                }
                continue;
            }
            let a = solution[row];
            row += 1;
            if i >= n {
                model.background[i - n] = a;
            } else if a < floor(i) && !model.has_signed_energies {
                is_free[i] = false;
                clipped = true;
            } else {
                model.sources[i].a = a;
            }
        }
        if !clipped {
            break;
        }
    }
}
