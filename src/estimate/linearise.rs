//! The normal equations: a hypothesis's gradient and information.

use super::atoms::Atoms;
use super::fit::Fitter;
use super::linear::{axpy, dot};
use super::model::Nuisances;
use super::reading::Reading;
use super::unusable::BadPixel;

impl Fitter {
    /// Gradient Jᵀr and information JᵀJ at the present hypothesis.
    #[inline(always)]
    pub(super) fn linearise(&mut self, reading: &Reading, nuisances: Nuisances) {
        let (mx, my) = (reading.mx, reading.my);
        let n = self.now.spots.len();
        let p = 3 * n + nuisances.count();
        let atoms = &self.now;
        let sources = atoms.sources();
        let h = &mut self.hessian;
        h.resize(p * p, 0.0);
        let g = &mut self.gradient;
        g.resize(p.max(g.len()), 0.0);
        for i in 0..sources {
            let ai = atoms.amplitude(i);
            for j in i..sources {
                let aj = atoms.amplitude(j);
                let c = atoms.couple(i, j, &reading.weights, &mut self.strip);
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
            let s = atoms.project(i, &self.residual, &mut self.strip);
            if i < n {
                (g[3 * i], g[3 * i + 1], g[3 * i + 2]) = (ai * s[1], ai * s[2], s[0]);
                if let Some(power) = atoms.spots[i].power {
                    h[(3 * i + 2) * p + 3 * i + 2] += power.precision;
                    g[3 * i + 2] += power.precision * (power.mean - ai);
                }
            } else {
                g[2 * n + i] = s[0];
            }
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
            for (d, w) in weighted.iter_mut().zip(&reading.weights) {
                *d *= w;
            }
            let column = first_width + w;
            for i in 0..sources {
                let s = atoms.project(i, weighted, &mut self.strip);
                if i < n {
                    let a = atoms.spots[i].a;
                    for (r, v) in [a * s[1], a * s[2], s[0]].into_iter().enumerate() {
                        h[(3 * i + r) * p + column] = v;
                    }
                } else {
                    h[(2 * n + i) * p + column] = s[0];
                }
            }
            for v in 0..=w {
                h[(first_width + v) * p + column] = dot(weighted, &self.broadening[v]);
            }
            g[first_width + w] = dot(&self.broadening[w], &self.residual);
        }
        for bad in &reading.bad {
            let row = &mut self.velocity;
            row.resize(p.max(row.len()), 0.0);
            let left = slope_at(bad, atoms, widths, &mut row[..p]);
            for i in (0..p).filter(|&i| row[i] != 0.0) {
                g[i] -= row[i] * left;
                let s = -row[i];
                axpy(s, &row[i..p], &mut h[i * p + i..(i + 1) * p]);
            }
        }
    }
}

/// What an unusable pixel holds beyond the model, and the model's slope there in all parameters.
#[inline(always)]
pub(super) fn slope_at(bad: &BadPixel, atoms: &Atoms, widths: usize, row: &mut [f64]) -> f64 {
    let (n, p) = (atoms.spots.len(), row.len());
    row[p - widths..].fill(0.0);
    let mut left = bad.value;
    for i in 0..atoms.sources() {
        let at = atoms.at(i, bad.x, bad.y);
        let a = atoms.amplitude(i);
        left -= a * at[0][0];
        if i >= n {
            row[2 * n + i] = at[0][0];
            continue;
        }
        (row[3 * i], row[3 * i + 1], row[3 * i + 2]) = (a * at[1][0], a * at[0][1], at[0][0]);
        if widths > 0 {
            row[p - widths] += a * atoms.width[0].powi(2) * at[2][0];
            row[p - widths + (widths - 1).min(1)] += a * atoms.width[1].powi(2) * at[0][2];
        }
        if widths > 2 {
            row[p - 1] += a * at[1][1];
        }
    }
    left
}
