//! Starting positions for overlapping spots: the half-kernel matrix pencil.
//!
//! With half-coordinates x_i, Y(x_i + x_j)·exp(−(x_i − x_j)²/2s²) = Σ A_k v_k(i) v_k(j) with v_k(i) = exp(−(x_i − x_k/2)²/s²):
//! a Gaussian mixture becomes a symmetric matrix of rank N whose vectors shift into each other,
//! v_k(i + 1) = λ_k ρ_i v_k(i), with λ_k = exp(x_k d/s²). Joint eigenvalues of the two shifts give the positions (the matrix
//! pencil of Hua and Sarkar, 1990, here for Gaussians instead of exponentials). All weights are at most 1, so the noise
//! gain is bounded for every σ.

use faer::linalg::solvers::SolveLstsq;
use faer::{Mat, Side};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;

/// Samples along an axis, odd so that every one is used, and their spacing, σ, where that gives a number in between. More resolve more
/// sources and cost the sixth power of their number in the eigenvalues of the half kernel.
const SAMPLES: [usize; 2] = [11, 15];
const SPACING: f64 = 0.33;
/// Centres per σ at which the sampling map is fitted to the Gaussian.
const CENTRES: f64 = 8.0;
/// Widest sensors, σ, for which the pencil is the main way to a hypothesis, and, with at least `FINE` pixels, a first try.
const WIDEST: [f64; 2] = [13.0, 16.0];
const FINE: usize = 30;
/// Where a basis leaves out at most this many of an array's pixels, its last columns only amplify the noise: the map is regularised
/// by this much instead of the basis's own error.
const NEARLY: usize = 4;
const FAINTEST: f64 = 1e-5;
/// Simulated frames of noise that set the scale of the singular values: the thresholds on the ratio, 0.5 and 4, need it only
/// roughly.
const DRAWS: usize = 6;
/// The linear combination of the two shifts whose eigenvectors are taken; any generic one does.
const MIX: [f64; 2] = [0.37, 0.63];

/// Maps a frame's coefficients to samples of a mixture of unit Gaussians, which undoes the pixels' integration.
pub(crate) struct PencilSampler {
    count: [usize; 2],
    /// Spacing and first sample, σ.
    spacing: [f64; 2],
    first: [f64; 2],
    rules: Vec<SamplingMap>,
}

/// The map from coefficients to samples for one pair of ranks.
struct SamplingMap {
    rank: [usize; 2],
    /// (samples, rank) along each axis.
    maps: [Mat<f64>; 2],
    /// Mean largest singular value of noise alone.
    noise: f64,
}

/// The frame's signal subspace, which gives starting positions for any number of emitters.
pub(crate) struct MatrixPencil {
    vectors: Mat<f64>,
    /// Singular values over that of noise alone, falling.
    pub singular_value_ratio: Vec<f64>,
    half: [usize; 2],
    spacing: [f64; 2],
    first: [f64; 2],
}

impl PencilSampler {
    /// `None` where spots are too small against the sensor for the pencil to resolve them with few samples.
    pub fn new(bx: &Basis, by: &Basis) -> Option<Self> {
        Self::up_to(WIDEST[0], 4, bx, by)
    }

    /// For sensors where spots mostly stand apart and the pencil is only tried first.
    pub fn for_pencil_start(bx: &Basis, by: &Basis) -> Option<Self> {
        let melted = Self::new(bx, by);
        if melted.is_some() {
            None
        } else {
            Self::up_to(WIDEST[1], FINE, bx, by)
        }
    }

    fn up_to(widest: f64, fewest: usize, bx: &Basis, by: &Basis) -> Option<Self> {
        if [bx, by]
            .iter()
            .any(|b| b.n < fewest || b.is_pixels || b.edges[b.n] - b.edges[0] > widest)
        {
            return None;
        }
        let extent = [bx, by].map(|b| b.edges[b.n] - b.edges[0]);
        let most = [bx, by].map(|b| ((b.n - 1) | 1).min(SAMPLES[1]));
        let count = [0, 1].map(|k| {
            let wanted = (extent[k] / SPACING).round() as usize | 1;
            wanted.max(SAMPLES[0]).min(most[k])
        });
        let spacing = [0, 1].map(|k| extent[k] / count[k] as f64);
        let first = [bx.edges[0] + 0.5 * spacing[0], by.edges[0] + 0.5 * spacing[1]];
        Some(Self {
            count,
            spacing,
            first,
            rules: Vec::new(),
        })
    }

    fn half(&self) -> [usize; 2] {
        self.count.map(|c| c.div_ceil(2))
    }

    /// The sampling map for the ranks of `compressed`, made on first use.
    fn rule(&mut self, compressed: &CompressedFrame, bx: &Basis, by: &Basis) -> &SamplingMap {
        let rank = [compressed.mx, compressed.my];
        let known = self.rules.iter().position(|r| r.rank == rank);
        let index = known.unwrap_or_else(|| {
            let maps = [self.map(0, bx, rank[0]), self.map(1, by, rank[1])];
            let mut rule = SamplingMap { rank, maps, noise: 1.0 };
            // The same draws for every camera and run.
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(0);
            let mut sum = 0.0;
            for _ in 0..DRAWS {
                let z = Mat::from_fn(rank[1], rank[0], |_, _| StandardNormal.sample(&mut rng));
                let eigen = self
                    .half_kernel(&rule, z.as_ref())
                    .self_adjoint_eigenvalues(Side::Lower);
                sum += eigen.map_or(0.0, |e| e.iter().fold(0.0, |a: f64, v| a.max(v.abs())));
            }
            rule.noise = (sum / DRAWS as f64).max(1e-300);
            self.rules.push(rule);
            self.rules.len() - 1
        });
        &self.rules[index]
    }

    /// Least squares over all centres, regularised where only noise would be amplified.
    fn map(&self, k: usize, basis: &Basis, rank: usize) -> Mat<f64> {
        let (lo, hi) = (basis.min_position(), basis.max_position());
        let centres = ((hi - lo) * CENTRES).ceil() as usize + 1;
        let at = |j: usize| lo + (hi - lo) * j as f64 / (centres - 1) as f64;
        let mut scratch = vec![0.0; 3 * basis.n.max(rank)];
        let mut atoms = Mat::<f64>::zeros(centres + rank, rank);
        let mut profile = vec![0.0; 3 * rank];
        for j in 0..centres {
            basis.profile(at(j), 1.0, psf_table::REACH, rank, &mut scratch, &mut profile);
            for c in 0..rank {
                atoms[(j, c)] = profile[c];
            }
        }
        let least = if rank + NEARLY >= basis.n { FAINTEST } else { 1e-14 };
        let held = basis.tail(rank).max(least);
        for c in 0..rank {
            atoms[(centres + c, c)] = held;
        }
        let samples = Mat::from_fn(centres + rank, self.count[k], |j, i| {
            let d = self.first[k] + i as f64 * self.spacing[k] - at(j.min(centres - 1));
            if j < centres { (-0.5 * d * d).exp() } else { 0.0 }
        });
        atoms.qr().solve_lstsq(&samples).transpose().to_owned()
    }

    fn half_kernel(&self, rule: &SamplingMap, z: faer::MatRef<f64>) -> Mat<f64> {
        let samples = &rule.maps[1] * z * rule.maps[0].transpose();
        let half = self.half();
        let size = half[0] * half[1];
        let kernel = [0, 1].map(|k| {
            (0..half[k])
                .map(|i| (-0.5 * (i as f64 * self.spacing[k]).powi(2)).exp())
                .collect::<Vec<_>>()
        });
        Mat::from_fn(size, size, |r, c| {
            let (ax, ay) = (r % half[0], r / half[0]);
            let (cx, cy) = (c % half[0], c / half[0]);
            samples[(ay + cy, ax + cx)] * kernel[0][ax.abs_diff(cx)] * kernel[1][ay.abs_diff(cy)]
        })
    }

    /// Analyses a frame.
    pub fn analyse(&mut self, compressed: &CompressedFrame, bx: &Basis, by: &Basis) -> Option<MatrixPencil> {
        self.rule(compressed, bx, by);
        let rank = [compressed.mx, compressed.my];
        let rule = self.rules.iter().find(|r| r.rank == rank)?;
        let z = faer::MatRef::from_row_major_slice(&compressed.coefficients, compressed.my, compressed.mx);
        let eigen = self.half_kernel(rule, z).self_adjoint_eigen(Side::Lower).ok()?;
        let half = self.half();
        let size = half[0] * half[1];
        let vectors = Mat::from_fn(size, size, |r, c| eigen.U()[(r, size - 1 - c)]);
        let singular_value_ratio = (0..size).map(|c| eigen.S()[size - 1 - c] / rule.noise).collect();
        Some(MatrixPencil {
            vectors,
            singular_value_ratio,
            half,
            spacing: self.spacing,
            first: self.first,
        })
    }
}

impl MatrixPencil {
    /// Most emitters that can be resolved.
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
            for (i, seed) in seeds.iter_mut().enumerate() {
                let lambda = turned[(i, i)];
                // Noise makes a close pair a complex one: its halves stand apart by their phase.
                let log = lambda.re.hypot(lambda.im).max(1e-300).ln() + lambda.im.atan2(lambda.re.abs());
                seed[k] = log / self.spacing[k];
            }
        }
        seeds.iter().all(|s| s.iter().all(|v| v.is_finite())).then_some(seeds)
    }

    /// The matrix that shifts the leading `count` vectors by one bin along axis `k`, in least squares.
    fn shift(&self, count: usize, k: usize) -> Mat<f64> {
        let [px, py] = self.half;
        let kept = if k == 0 { [px - 1, py] } else { [px, py - 1] };
        let rows = kept[0] * kept[1];
        let d = self.spacing[k];
        let root = |i: usize| {
            let x = 0.5 * self.first[k] + i as f64 * d;
            (-(2.0 * x * d + d * d) / 2.0).exp()
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
    fn recovers_overlapping_spots_without_noise() {
        let basis = || Basis::new(&Axis::centred(60, 0.03), 0.008);
        let (bx, by) = (basis(), basis());
        let truth = [[-1.1, 0.7], [0.2, 0.9], [1.3, -1.2], [-0.4, -0.8]];
        let mut pixels = vec![0.0; 3600];
        let mut rows = [vec![0.0; 60], vec![0.0; 60]];
        for t in truth {
            for (k, row) in rows.iter_mut().enumerate() {
                let mut rest = [vec![0.0; 60], vec![0.0; 60]];
                let [a, b] = &mut rest;
                crate::estimate::model::psf_table::profile(
                    &bx.edges,
                    t[k],
                    1.0,
                    crate::estimate::model::psf_table::REACH,
                    row,
                    a,
                    b,
                );
            }
            for y in 0..60 {
                for x in 0..60 {
                    pixels[y * 60 + x] += 1e7 * rows[1][y] * rows[0][x];
                }
            }
        }
        let frame = crate::estimate::preprocess::screening::PreprocessedFrame {
            is_masked: vec![false; pixels.len()],
            pixels,
            ..Default::default()
        };
        let mut compressed = CompressedFrame::default();
        compressed.load(&frame, &bx, &by);
        let mut sampler = PencilSampler::new(&bx, &by).unwrap();
        let pencil = sampler.analyse(&compressed, &bx, &by).unwrap();
        let seeds = pencil.seeds(4).unwrap();
        for t in truth {
            let nearest = seeds
                .iter()
                .map(|s| (s[0] - t[0]).hypot(s[1] - t[1]))
                .fold(f64::MAX, f64::min);
            // What the basis leaves out, 2e-9 of a spot here, under the pencil's own gain.
            assert!(nearest < 1e-4, "{t:?}: {seeds:?}");
        }
    }
}
