//! The normal equations: a hypothesis's gradient and information.

use crate::estimate::dense_linalg::{axpy, dot};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Nuisances;

impl Fitter {
    /// Gradient Jᵀr and information JᵀJ at the present hypothesis.
    #[inline(always)]
    pub(crate) fn linearise(&mut self, reading: &Reading, nuisances: Nuisances) {
        let (mx, my) = (reading.mx, reading.my);
        let n = self.now.spots.len();
        let p = 3 * n + nuisances.count();
        let atoms = &self.now;
        let sources = atoms.sources();
        let h = &mut self.hessian;
        h.resize(p * p, 0.0);
        let g = &mut self.gradient;
        g.resize(p.max(g.len()), 0.0);
        let runs = reading.bad.runs();
        for i in 0..sources {
            let ai = atoms.amplitude(i);
            for j in i..sources {
                let aj = atoms.amplitude(j);
                let mut c = atoms.couple(i, j, &reading.weights, &mut self.strip);
                if !runs.is_empty() {
                    let taken = atoms.couple_at(i, j, runs, &mut self.strip);
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
        atoms.slopes(&self.residual, &mut self.strip, &mut g[..p]);
        for (i, spot) in atoms.spots.iter().enumerate() {
            if let Some(power) = spot.power {
                h[(3 * i + 2) * (p + 1)] += power.precision;
                g[3 * i + 2] += power.precision * (power.mean - spot.a);
            }
        }
        if let Some(tether) = &self.tether {
            tether.linearise(&atoms.spots, g, h, p);
        }
        let widths = nuisances.widths();
        let first_width = p - widths;
        for d in &mut self.broadening[..widths] {
            d.clear();
            d.resize(mx * my, 0.0);
        }
        // ∂/∂ln w of a spot is w² f″ (the heat equation).
        for i in 0..if widths > 0 { n } else { 0 } {
            let [ax, ay] = atoms.width.map(|w| atoms.spots[i].a * w * w);
            atoms.add(i, 2, 0, ax, &mut self.broadening[0]);
            atoms.add(i, 0, 2, ay, &mut self.broadening[(widths - 1).min(1)]);
            if widths > 2 {
                atoms.add(i, 1, 1, atoms.spots[i].a, &mut self.broadening[2]);
            }
        }
        for w in 0..widths {
            let weighted = &mut self.weighted;
            weighted.clone_from(&self.broadening[w]);
            reading.weight(weighted, [&self.bx, &self.by], false, &mut self.scratch);
            let column = first_width + w;
            let shared = &mut self.velocity;
            shared.resize(p.max(shared.len()), 0.0);
            atoms.slopes(weighted, &mut self.strip, shared);
            for i in 0..first_width {
                h[i * p + column] = shared[i];
            }
            for v in 0..=w {
                h[(first_width + v) * p + column] = dot(weighted, &self.broadening[v]);
            }
            g[first_width + w] = dot(&self.broadening[w], &self.residual);
        }
        for bad in reading.bad.scattered() {
            let row = &mut self.velocity;
            row.resize(p.max(row.len()), 0.0);
            atoms.slopes_at([bad.x, bad.y], row);
            for i in 0..first_width {
                if row[i] != 0.0 {
                    let s = -row[i];
                    axpy(s, &row[i..first_width], &mut h[i * p + i..i * p + first_width]);
                }
            }
        }
    }
}
