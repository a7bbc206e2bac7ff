//! The linear part of the joint fit: energies at given positions.

use crate::estimate::dense_linalg::{axpy, cholesky, solve};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::separable_model::SLOPES;

/// Amplitudes stay above this many standard deviations of noise, so that a position keeps its gradient.
const AMPLITUDE_FLOOR: f64 = 0.05;

impl Fitter {
    /// Least-squares amplitudes at the atoms' positions; those of spots are kept above a floor by an active set.
    #[inline(always)]
    pub(crate) fn solve_amplitudes(&mut self, reading: &Reading, is_trial: bool) {
        let atoms = if is_trial { &mut self.trial } else { &mut self.now };
        let n = atoms.spots.len();
        let sources = atoms.sources();
        if sources == 0 {
            return;
        }
        self.small.resize(sources * sources, 0.0);
        let gram = &mut self.small;
        let rhs = &mut self.acceleration;
        rhs.resize(sources.max(rhs.len()), 0.0);
        for i in 0..sources {
            for j in 0..=i {
                gram[i * sources + j] = atoms.inner(i, [0, 0], j, [0, 0], &reading.weights, &mut self.strip);
            }
            rhs[i] = atoms.project_value(i, reading.weighted(), &mut self.strip);
            if let Some(power) = atoms.spots.get(i).and_then(|s| s.power) {
                gram[i * sources + i] += power.precision;
                rhs[i] += power.precision * power.mean;
            }
        }
        let runs = reading.bad.runs();
        for i in 0..if runs.is_empty() { 0 } else { sources } {
            for j in 0..=i {
                gram[i * sources + j] -= atoms.couple_at(i, j, runs, &mut self.strip)[8];
            }
        }
        for bad in reading.bad.scattered() {
            let values = &mut self.scratch;
            values.resize(values.len().max(sources), 0.0);
            for i in 0..sources {
                values[i] = atoms.at(i, [bad.x, bad.y], SLOPES)[0];
            }
            for i in 0..sources {
                if values[i] != 0.0 {
                    let s = -values[i];
                    axpy(s, &values[..i + 1], &mut gram[i * sources..i * sources + i + 1]);
                }
            }
        }
        self.active.clear();
        self.active.resize(sources, true);
        let factor = &mut self.factor;
        let solution = &mut self.bend;
        solution.resize(sources.max(solution.len()), 0.0);
        let floor = |i: usize| AMPLITUDE_FLOOR / gram[i * sources + i].max(1e-30).sqrt();
        loop {
            let mut order = 0;
            factor.resize(factor.len().max(sources * sources), 0.0);
            let size = self.active.iter().filter(|a| **a).count();
            for i in (0..sources).filter(|&i| self.active[i]) {
                let mut b = rhs[i];
                for k in (0..sources).filter(|&k| !self.active[k]) {
                    b -= gram[i.max(k) * sources + i.min(k)] * floor(k);
                }
                solution[order] = b;
                for (column, j) in (0..=i).filter(|&j| self.active[j]).enumerate() {
                    factor[column * size + order] = gram[i * sources + j];
                }
                factor[order * size + order] *= 1.0 + 1e-13;
                order += 1;
            }
            if size > 0 {
                let mut ridge = 1e-12;
                while !cholesky(&mut factor[..size * size], size) {
                    let mut row = 0;
                    for i in (0..sources).filter(|&i| self.active[i]) {
                        for (column, j) in (0..=i).filter(|&j| self.active[j]).enumerate() {
                            factor[column * size + row] = gram[i * sources + j];
                        }
                        factor[row * size + row] = gram[i * sources + i].max(1e-30) * (1.0 + ridge);
                        row += 1;
                    }
                    ridge *= 10.0;
                }
                solve(factor, size, solution);
            }
            let mut row = 0;
            let mut clipped = false;
            for i in 0..sources {
                if !self.active[i] {
                    if i < n {
                        atoms.spots[i].a = floor(i);
                    }
                    continue;
                }
                let a = solution[row];
                row += 1;
                if i >= n {
                    atoms.background[i - n] = a;
                } else if a < floor(i) {
                    self.active[i] = false;
                    clipped = true;
                } else {
                    atoms.spots[i].a = a;
                }
            }
            if !clipped {
                break;
            }
        }
    }
}
