//! Seeds for overlapping spots: the half-kernel matrix pencil.
//!
//! With half-coordinates x_i, Y(x_i + x_j)·exp(−(x_i − x_j)²/2s²) = Σ A_k v_k(i) v_k(j) with v_k(i) = exp(−(x_i − x_k/2)²/s²):
//! a Gaussian mixture becomes a symmetric matrix of rank N whose vectors shift into each other,
//! v_k(i + 1) = λ_k ρ_i v_k(i), with λ_k = exp(x_k d/s²). Joint eigenvalues of the two shifts give the positions (the matrix
//! pencil of Hua and Sarkar, 1990, here for Gaussians instead of exponentials). All weights are at most 1, so the noise
//! gain is bounded for every σ.

use faer::linalg::solvers::SolveLstsq;
use faer::{Mat, Side};

use super::basis::Basis;

/// Bins along an axis, and their width, σ, where that gives a number in between.
const BINS: [usize; 2] = [10, 16];
const WIDTH: f64 = 0.55;
/// The mix of the two shifts whose eigenvectors are taken; any generic one does.
const MIX: [f64; 2] = [0.37, 0.63];

/// The frame's signal subspace, from which seeds for any number of emitters can be had.
pub(super) struct Pencil {
    vectors: Mat<f64>,
    /// Singular values over what noise alone reaches, falling.
    pub strength: Vec<f64>,
    half: [usize; 2],
    /// Bin width and first bin centre, σ.
    width: [f64; 2],
    first: [f64; 2],
}

impl Pencil {
    /// Whether spots are wide enough against the sensor for the pencil to resolve them with few bins.
    pub fn suits(bx: &Basis, by: &Basis) -> bool {
        [bx, by].iter().all(|b| b.n >= 4 && (b.edges[b.n] - b.edges[0]) <= 13.0)
    }

    /// Analyses pixels (Ny, Nx) in units of the noise.
    pub fn new(pixels: &[f64], bx: &Basis, by: &Basis) -> Option<Self> {
        let per_bin = [bx, by].map(|b| {
            let wanted = (WIDTH / b.pitch()).round() as usize;
            wanted.min(b.n / BINS[0]).max(b.n.div_ceil(BINS[1]))
        });
        let bins = [bx.n / per_bin[0], by.n / per_bin[1]];
        let offset = [(bx.n % per_bin[0]) / 2, (by.n % per_bin[1]) / 2];
        let half = bins.map(|b| b.div_ceil(2));
        if half.iter().any(|&h| h < 2) {
            return None;
        }
        let mut binned = vec![0.0; bins[0] * bins[1]];
        for y in 0..bins[1] * per_bin[1] {
            let row = &pixels[(y + offset[1]) * bx.n + offset[0]..];
            for x in 0..bins[0] * per_bin[0] {
                binned[y / per_bin[1] * bins[0] + x / per_bin[0]] += row[x];
            }
        }
        let width = [per_bin[0] as f64 * bx.pitch(), per_bin[1] as f64 * by.pitch()];
        let first = [
            bx.edges[offset[0]] + 0.5 * width[0],
            by.edges[offset[1]] + 0.5 * width[1],
        ];
        let kernel = [0, 1].map(|k| {
            let s2 = 1.0 + width[k] * width[k] / 12.0;
            (0..half[k])
                .map(|i| (-(i as f64 * width[k]).powi(2) / (2.0 * s2)).exp())
                .collect::<Vec<_>>()
        });
        let size = half[0] * half[1];
        let h = Mat::from_fn(size, size, |r, c| {
            let (ax, ay) = (r % half[0], r / half[0]);
            let (cx, cy) = (c % half[0], c / half[0]);
            binned[(ay + cy) * bins[0] + ax + cx] * kernel[0][ax.abs_diff(cx)] * kernel[1][ay.abs_diff(cy)]
        });
        let eigen = h.self_adjoint_eigen(Side::Lower).ok()?;
        // Largest eigenvalue of the noise alone, about twice its entries' scale times √size (Wigner's semicircle).
        let noise = ((per_bin[0] * per_bin[1]) as f64 * size as f64).sqrt();
        let vectors = Mat::from_fn(size, size, |r, c| eigen.U()[(r, size - 1 - c)]);
        let strength = (0..size).map(|c| eigen.S()[size - 1 - c] / noise).collect();
        Some(Self {
            vectors,
            strength,
            half,
            width,
            first,
        })
    }

    /// Most emitters that can be told apart.
    pub fn most(&self) -> usize {
        ((self.half[0] - 1) * self.half[1]).min((self.half[1] - 1) * self.half[0])
    }

    /// Positions, σ, of `count` emitters.
    pub fn seeds(&self, count: usize) -> Option<Vec<[f64; 2]>> {
        if count == 0 || count > self.most() {
            return None;
        }
        let shifts = [self.shift(count, 0), self.shift(count, 1)];
        let mixed = Mat::from_fn(count, count, |r, c| {
            MIX[0] * shifts[0][(r, c)] + MIX[1] * shifts[1][(r, c)]
        });
        if (0..count).any(|c| (0..count).any(|r| !mixed[(r, c)].is_finite())) {
            return None;
        }
        let eigen = mixed.eigen().ok()?;
        let vectors = eigen.U();
        let lu = vectors.partial_piv_lu();
        let mut seeds = vec![[0.0; 2]; count];
        for (k, shift) in shifts.iter().enumerate() {
            let complex = Mat::from_fn(count, count, |r, c| faer::c64::new(shift[(r, c)], 0.0));
            let turned = faer::linalg::solvers::Solve::solve(&lu, &complex * vectors);
            let s2 = 1.0 + self.width[k] * self.width[k] / 12.0;
            for (i, seed) in seeds.iter_mut().enumerate() {
                let lambda = turned[(i, i)];
                // Noise makes a close pair a complex one: its halves stand apart by their phase.
                let log = lambda.re.hypot(lambda.im).max(1e-300).ln() + lambda.im.atan2(lambda.re.abs());
                seed[k] = log * s2 / self.width[k];
            }
        }
        seeds.iter().all(|s| s.iter().all(|v| v.is_finite())).then_some(seeds)
    }

    /// The matrix that shifts the leading `count` vectors by one bin along axis `k`, in least squares.
    fn shift(&self, count: usize, k: usize) -> Mat<f64> {
        let [px, py] = self.half;
        let kept = if k == 0 { [px - 1, py] } else { [px, py - 1] };
        let rows = kept[0] * kept[1];
        let (d, s2) = (self.width[k], 1.0 + self.width[k] * self.width[k] / 12.0);
        let root = |i: usize| {
            let x = 0.5 * self.first[k] + i as f64 * d;
            (-(2.0 * x * d + d * d) / (2.0 * s2)).exp()
        };
        let at = |r: usize, up: usize| {
            let (a, b) = (r % kept[0], r / kept[0]);
            if k == 0 {
                (b * px + a + up, a)
            } else {
                ((b + up) * px + a, b)
            }
        };
        let lower = Mat::from_fn(rows, count, |r, c| {
            let (row, i) = at(r, 0);
            self.vectors[(row, c)] * root(i)
        });
        let upper = Mat::from_fn(rows, count, |r, c| {
            let (row, i) = at(r, 1);
            self.vectors[(row, c)] / root(i)
        });
        lower.qr().solve_lstsq(&upper)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::Axis;

    #[test]
    fn recovers_melted_spots_without_noise() {
        let basis = || Basis::new(&Axis::centred(60, 0.03), 0.008);
        let (bx, by) = (basis(), basis());
        let truth = [[-1.1, 0.7], [0.2, 0.9], [1.3, -1.2], [-0.4, -0.8]];
        let mut pixels = vec![0.0; 3600];
        let mut rows = [vec![0.0; 60], vec![0.0; 60]];
        for t in truth {
            for (k, row) in rows.iter_mut().enumerate() {
                let mut rest = [vec![0.0; 60], vec![0.0; 60]];
                let [a, b] = &mut rest;
                super::super::spot::profile(&bx.edges, t[k], 1.0, super::super::spot::REACH, row, a, b);
            }
            for y in 0..60 {
                for x in 0..60 {
                    pixels[y * 60 + x] += 1e7 * rows[1][y] * rows[0][x];
                }
            }
        }
        let seeds = Pencil::new(&pixels, &bx, &by).unwrap().seeds(4).unwrap();
        for t in truth {
            let nearest = seeds
                .iter()
                .map(|s| (s[0] - t[0]).hypot(s[1] - t[1]))
                .fold(f64::MAX, f64::min);
            // A bin is taken for a Gaussian of its variance; its fourth moment shows at this level.
            assert!(nearest < 0.05, "{t:?}: {seeds:?}");
        }
    }
}
