//! The linear part of the fit: amplitudes at given positions by least squares, with a lower bound on those of sources.

use crate::estimate::dense_linalg::{axpy, cholesky, solve};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::separable_model::SLOPES;

/// Lower bound of a source's amplitude in standard deviations of a lone one's: at zero its position would have no gradient.
const AMPLITUDE_FLOOR: f64 = 0.05;

impl Fitter {
    /// Solves the amplitudes of the current or the trial model; sources that fall below the bound are fixed at it (active set).
    #[inline(always)]
    pub(crate) fn solve_amplitudes(&mut self, compressed: &CompressedFrame, is_trial: bool) {
        let separable = if is_trial { &mut self.trial } else { &mut self.current };
        let n = separable.sources.len();
        let components = separable.components();
        if components == 0 {
            return;
        }
        self.amplitude_gram.resize(components * components, 0.0);
        let gram = &mut self.amplitude_gram;
        let rhs = &mut self.acceleration;
        rhs.resize(components.max(rhs.len()), 0.0);
        for i in 0..components {
            for j in 0..=i {
                gram[i * components + j] =
                    separable.inner_product(i, [0, 0], j, [0, 0], &compressed.weights, &mut self.strip);
            }
            rhs[i] = separable.project_value(i, compressed.weighted_coefficients(), &mut self.strip);
            if let Some(power) = separable.sources.get(i).and_then(|s| s.power) {
                gram[i * components + i] += power.precision;
                rhs[i] += power.precision * power.mean;
            }
        }
        let runs = compressed.masked.runs();
        for i in 0..if runs.is_empty() { 0 } else { components } {
            for j in 0..=i {
                gram[i * components + j] -= separable.gram_block_over_runs(i, j, runs, &mut self.strip)[8];
            }
        }
        for bad in compressed.masked.scattered() {
            let values = &mut self.scratch;
            values.resize(values.len().max(components), 0.0);
            for i in 0..components {
                values[i] = separable.derivatives_at(i, [bad.x, bad.y], SLOPES)[0];
            }
            for i in 0..components {
                if values[i] != 0.0 {
                    let s = -values[i];
                    axpy(s, &values[..i + 1], &mut gram[i * components..i * components + i + 1]);
                }
            }
        }
        self.is_free.clear();
        self.is_free.resize(components, true);
        let factor = &mut self.factor;
        let solution = &mut self.second_derivative;
        solution.resize(components.max(solution.len()), 0.0);
        let floor = |i: usize| AMPLITUDE_FLOOR / gram[i * components + i].max(1e-30).sqrt();
        loop {
            let mut order = 0;
            factor.resize(factor.len().max(components * components), 0.0);
            let size = self.is_free.iter().filter(|a| **a).count();
            for i in (0..components).filter(|&i| self.is_free[i]) {
                let mut b = rhs[i];
                for k in (0..components).filter(|&k| !self.is_free[k]) {
                    b -= gram[i.max(k) * components + i.min(k)] * floor(k);
                }
                solution[order] = b;
                for (column, j) in (0..=i).filter(|&j| self.is_free[j]).enumerate() {
                    factor[column * size + order] = gram[i * components + j];
                }
                factor[order * size + order] *= 1.0 + 1e-13;
                order += 1;
            }
            if size > 0 {
                let mut ridge = 1e-12;
                while !cholesky(&mut factor[..size * size], size) {
                    let mut row = 0;
                    for i in (0..components).filter(|&i| self.is_free[i]) {
                        for (column, j) in (0..=i).filter(|&j| self.is_free[j]).enumerate() {
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
                if !self.is_free[i] {
                    if i < n {
                        separable.sources[i].a = floor(i);
                    }
                    continue;
                }
                let a = solution[row];
                row += 1;
                if i >= n {
                    separable.background[i - n] = a;
                } else if a < floor(i) {
                    self.is_free[i] = false;
                    clipped = true;
                } else {
                    separable.sources[i].a = a;
                }
            }
            if !clipped {
                break;
            }
        }
    }
}
