//! The normal equations: gradient and information matrix of a hypothesis.

use crate::estimate::dense_linalg::{axpy, dot};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Nuisances;

impl Fitter {
    /// Sets gradient Jᵀr and information JᵀJ of the current model.
    #[inline(always)]
    pub(crate) fn compute_normal_equations(&mut self, compressed: &CompressedFrame, nuisances: Nuisances) {
        let (mx, my) = (compressed.mx, compressed.my);
        let n = self.current.sources.len();
        let p = 3 * n + nuisances.count();
        let separable = &self.current;
        let components = separable.components();
        let h = &mut self.hessian;
        h.resize(p * p, 0.0);
        let g = &mut self.gradient;
        g.resize(p.max(g.len()), 0.0);
        let runs = compressed.masked.runs();
        for i in 0..components {
            let ai = separable.amplitude(i);
            for j in i..components {
                let aj = separable.amplitude(j);
                let mut c = separable.gram_block(i, j, &compressed.weights, &mut self.strip);
                if !runs.is_empty() {
                    let taken = separable.gram_block_over_runs(i, j, runs, &mut self.strip);
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
        separable.transposed_jacobian_times(&self.residual, &mut self.strip, &mut g[..p]);
        for (i, source) in separable.sources.iter().enumerate() {
            if let Some(power) = source.power {
                h[(3 * i + 2) * (p + 1)] += power.precision;
                g[3 * i + 2] += power.precision * (power.mean - source.a);
            }
        }
        if let Some(profile_constraint) = &self.profile_constraint {
            profile_constraint.add_normal_equations(&separable.sources, g, h, p);
        }
        let widths = nuisances.widths();
        let first_width = p - widths;
        for d in &mut self.width_derivatives[..widths] {
            d.clear();
            d.resize(mx * my, 0.0);
        }
        // ∂/∂ln w of a source is w² f″ (the heat equation).
        for i in 0..if widths > 0 { n } else { 0 } {
            let [ax, ay] = separable.width.map(|w| separable.sources[i].a * w * w);
            separable.accumulate(i, 2, 0, ax, &mut self.width_derivatives[0]);
            separable.accumulate(i, 0, 2, ay, &mut self.width_derivatives[(widths - 1).min(1)]);
            if widths > 2 {
                separable.accumulate(i, 1, 1, separable.sources[i].a, &mut self.width_derivatives[2]);
            }
        }
        for w in 0..widths {
            let weighted = &mut self.weighted_derivative;
            weighted.clone_from(&self.width_derivatives[w]);
            compressed.apply_weights(weighted, [&self.bx, &self.by], false, &mut self.scratch);
            let column = first_width + w;
            let shared = &mut self.velocity;
            shared.resize(p.max(shared.len()), 0.0);
            separable.transposed_jacobian_times(weighted, &mut self.strip, shared);
            for i in 0..first_width {
                h[i * p + column] = shared[i];
            }
            for v in 0..=w {
                h[(first_width + v) * p + column] = dot(weighted, &self.width_derivatives[v]);
            }
            g[first_width + w] = dot(&self.width_derivatives[w], &self.residual);
        }
        for bad in compressed.masked.scattered() {
            let row = &mut self.velocity;
            row.resize(p.max(row.len()), 0.0);
            separable.jacobian_row_at([bad.x, bad.y], row);
            for i in 0..first_width {
                if row[i] != 0.0 {
                    let s = -row[i];
                    axpy(s, &row[i..first_width], &mut h[i * p + i..i * p + first_width]);
                }
            }
        }
    }
}
