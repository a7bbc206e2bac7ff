//! The normal equations of a hypothesis: gradient Jᵀr and information JᵀJ over (x, y, energy) of each source, then background, then
//! widths, in units of σ and of the noise.

use crate::estimate::dense_linalg::{axpy, dot};
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::scratch::Scratch;
use crate::estimate::model::hypothesis::Nuisances;

/// Gradient and information at one hypothesis.
#[derive(Default)]
pub(crate) struct NormalEquations {
    pub sources: usize,
    pub parameters: usize,
    /// JᵀJ, (p, p) row-major; only the upper triangle and the sources' 3 × 3 blocks are set.
    pub information: Vec<f64>,
    pub gradient: Vec<f64>,
    /// The predicted frame's derivatives in the logarithms of the widths and in the covariance between the axes, (my, mx).
    width_derivatives: [Vec<f64>; 3],
    width_count: usize,
}

impl NormalEquations {
    /// Of sources alone, with a gradient of zero.
    #[cfg(test)]
    pub fn of_sources(information: Vec<f64>) -> Self {
        let parameters = information.len().isqrt();
        Self {
            sources: parameters / 3,
            parameters,
            information,
            gradient: vec![0.0; parameters],
            ..Self::default()
        }
    }

    /// The predicted frame's derivatives in the fitted widths, (my, mx) each.
    #[inline(always)]
    pub fn widths(&self) -> &[Vec<f64>] {
        &self.width_derivatives[..self.width_count]
    }

    /// Sets gradient and information of an evaluated hypothesis.
    #[inline(always)]
    pub fn compute(&mut self, problem: Problem, nuisances: Nuisances, at: &Evaluation, scratch: &mut Scratch) {
        self.compute_weighted(problem, &problem.compressed.weights, nuisances, at, scratch);
    }

    /// The same with other weights in the information of sources and background.
    #[inline(always)]
    pub fn compute_weighted(
        &mut self,
        problem: Problem,
        weights: &[f64],
        nuisances: Nuisances,
        at: &Evaluation,
        scratch: &mut Scratch,
    ) {
        let (compressed, model) = (problem.compressed, &at.model);
        let (mx, my) = (compressed.mx, compressed.my);
        let n = model.sources.len();
        let p = 3 * n + nuisances.count();
        let widths = nuisances.widths();
        (self.sources, self.parameters, self.width_count) = (n, p, widths);
        let components = model.components();
        let h = &mut self.information;
        h.resize(p * p, 0.0);
        let g = &mut self.gradient;
        g.resize(p, 0.0);
        let runs = compressed.masked.runs();
        for i in 0..components {
            let ai = model.amplitude(i);
            for j in i..components {
                let aj = model.amplitude(j);
                let mut c = model.gram_block(i, j, weights, &mut scratch.strip);
                if !runs.is_empty() {
                    let taken = model.gram_block_over_runs(i, j, runs, &mut scratch.strip);
                    for k in 0..9 {
                        c[k] -= taken[k];
                    }
                }
                if j < n {
                    let block = [
                        ai * aj * c[0],
                        ai * aj * c[1],
                        ai * c[2],
                        ai * aj * c[3],
                        ai * aj * c[4],
                        ai * c[5],
                        aj * c[6],
                        aj * c[7],
                        c[8],
                    ];
                    for r in 0..3 {
                        h[(3 * i + r) * p + 3 * j..(3 * i + r) * p + 3 * j + 3]
                            .copy_from_slice(&block[3 * r..3 * r + 3]);
                    }
                } else if i < n {
                    for (r, v) in [ai * c[2], ai * c[5], c[8]].into_iter().enumerate() {
                        h[(3 * i + r) * p + 2 * n + j] = v;
                    }
                } else {
                    h[(2 * n + i) * p + 2 * n + j] = c[8];
                }
            }
        }
        model.transposed_jacobian_times(&at.residual, &mut scratch.strip, g);
        for (i, source) in model.sources.iter().enumerate() {
            if let Some(power) = source.power {
                h[(3 * i + 2) * (p + 1)] += power.precision;
                g[3 * i + 2] += power.precision * (power.mean - source.a);
            }
        }
        if let Some(constraint) = problem.constraint {
            constraint.add_normal_equations(&model.sources, g, h, p);
        }
        let first_width = p - widths;
        for d in &mut self.width_derivatives[..widths] {
            d.clear();
            d.resize(mx * my, 0.0);
        }
        // ∂/∂ln w of a source is w² f″ (the heat equation).
        for i in 0..if widths > 0 { n } else { 0 } {
            let [ax, ay] = model.width.map(|w| model.sources[i].a * w * w);
            model.accumulate(i, 2, 0, ax, &mut self.width_derivatives[0]);
            model.accumulate(i, 0, 2, ay, &mut self.width_derivatives[(widths - 1).min(1)]);
            if widths > 2 {
                model.accumulate(i, 1, 1, model.sources[i].a, &mut self.width_derivatives[2]);
            }
        }
        scratch.vector.resize(p, 0.0);
        for w in 0..widths {
            let weighted = &mut scratch.matrix;
            weighted.clone_from(&self.width_derivatives[w]);
            compressed.apply_weights(weighted, problem.bases.axes(), false, &mut scratch.profiles);
            let column = first_width + w;
            let shared = &mut scratch.vector;
            model.transposed_jacobian_times(weighted, &mut scratch.strip, shared);
            for i in 0..first_width {
                h[i * p + column] = shared[i];
            }
            for v in 0..=w {
                h[(first_width + v) * p + column] = dot(weighted, &self.width_derivatives[v]);
            }
            g[first_width + w] = dot(&self.width_derivatives[w], &at.residual);
        }
        for bad in compressed.masked.scattered() {
            let row = &mut scratch.vector;
            model.jacobian_row_at([bad.x, bad.y], row);
            for i in 0..first_width {
                if row[i] != 0.0 {
                    let s = -row[i];
                    axpy(s, &row[i..first_width], &mut h[i * p + i..i * p + first_width]);
                }
            }
        }
    }
}
