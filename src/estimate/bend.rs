//! How a spot is bent: what the residual says of a second moment that one emitter does not have. Two emitters too near to be told
//! apart look like one whose light is spread along the line between them, so this is the score test of a split (Rao, 1948), with
//! all that the model would adjust taken out.

use super::Bend;
use super::atoms::Atoms;
use super::fit::Fitter;
use super::linear::{axpy, dot};
use super::linearise::slope_at;
use super::model::Model;
use super::reading::Reading;

/// The derivatives that go with the second moments xx, xy, yy, and what multiplies them: a spot spread by M changes by
/// ½A(M_xx f_xx + 2 M_xy f_xy + M_yy f_yy).
const SECOND: [([usize; 2], f64); 3] = [([2, 0], 0.5), ([1, 1], 1.0), ([0, 2], 0.5)];
/// Derivatives along x and y that go with a spot's x, y and energy.
const FIRST: [[usize; 2]; 3] = [[1, 0], [0, 1], [0, 0]];
/// Directions that are looked in, over half a turn.
const DIRECTIONS: usize = 16;
/// A direction of which less than this share is left beside what the model adjusts says nothing.
const LEAST: f64 = 1e-6;

/// A split that a bend asks for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Split {
    /// Drop of the deviance that it promises, to second order.
    pub gain: f64,
    pub index: usize,
    pub direction: [f64; 2],
    /// How far to either side equal halves would lie, σ.
    pub distance: f64,
}

impl Bend {
    /// The split along the direction that gains most, if any gains.
    pub(super) fn split(&self, index: usize) -> Option<Split> {
        let (g, s) = (&self.score, &self.information);
        let along = |k: usize| {
            let (y, x) = (std::f64::consts::PI * k as f64 / DIRECTIONS as f64).sin_cos();
            let v = [x * x, x * y, y * y];
            let slope: f64 = (0..3).map(|r| g[r] * v[r]).sum();
            let curvature: f64 = (0..3).map(|r| v[r] * (0..3).map(|c| s[r][c] * v[c]).sum::<f64>()).sum();
            (slope > 0.0 && curvature > 0.0).then(|| Split {
                gain: slope * slope / curvature,
                index,
                direction: [x, y],
                distance: (slope / curvature).sqrt(),
            })
        };
        (0..DIRECTIONS)
            .filter_map(along)
            .max_by(|a, b| a.gain.total_cmp(&b.gain))
    }
}

impl Fitter {
    /// How each spot of `model` is bent, given the inverse of the information matrix that was set last, (p, p).
    pub fn bends(&mut self, reading: &Reading, model: &Model, covariance: &[f64]) -> Vec<Bend> {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            reading,
            model,
            covariance,
        })
    }

    #[inline(always)]
    fn bent(&mut self, reading: &Reading, model: &Model, covariance: &[f64]) -> Vec<Bend> {
        let p = model.parameters();
        let widths = model.nuisances.widths();
        self.work += (model.spots.len() * p * (3 * reading.bad.len() + 3 * p)) as f64;
        let mut rows = Vec::new();
        let mut lefts = Vec::new();
        for bad in &reading.bad {
            let start = rows.len();
            rows.resize(start + p, 0.0);
            lefts.push(slope_at(bad, &self.now, widths, &mut rows[start..]));
        }
        let (mut cross, mut taken) = (vec![0.0; 3 * p], vec![0.0; 3 * p]);
        let mut bends = Vec::with_capacity(model.spots.len());
        for i in 0..model.spots.len() {
            cross.fill(0.0);
            let (mut score, mut information) = self.raw_bend(reading, i, widths, &mut cross);
            let atoms = &self.now;
            for (k, bad) in reading.bad.iter().enumerate() {
                let at = atoms.at(i, bad.x, bad.y);
                let a = atoms.amplitude(i);
                let own = [0.5 * a * at[2][0], a * at[1][1], 0.5 * a * at[0][2]];
                if own == [0.0; 3] {
                    continue;
                }
                for r in 0..3 {
                    score[r] -= own[r] * lefts[k];
                    axpy(-own[r], &rows[k * p..(k + 1) * p], &mut cross[r * p..(r + 1) * p]);
                    for c in 0..3 {
                        information[r][c] -= own[r] * own[c];
                    }
                }
            }
            let whole = information;
            for r in 0..3 {
                for k in 0..p {
                    taken[r * p + k] = dot(&cross[r * p..(r + 1) * p], &covariance[k * p..(k + 1) * p]);
                }
            }
            for r in 0..3 {
                let taken = &taken[r * p..(r + 1) * p];
                score[r] -= dot(taken, &self.gradient[..p]);
                for c in 0..3 {
                    information[r][c] -= dot(taken, &cross[c * p..(c + 1) * p]);
                }
            }
            let is_left = (0..3).all(|r| information[r][r] > LEAST * whole[r][r]);
            bends.push(if is_left {
                Bend { score, information }
            } else {
                Bend::default()
            });
        }
        bends
    }

    /// Score and information of spot `i`'s second moments, and what they share with the model's parameters, (3, p); unusable
    /// pixels not taken out yet.
    #[inline(always)]
    fn raw_bend(&mut self, reading: &Reading, i: usize, widths: usize, cross: &mut [f64]) -> ([f64; 3], [[f64; 3]; 3]) {
        let p = cross.len() / 3;
        let atoms: &Atoms = &self.now;
        let n = atoms.spots.len();
        let own = SECOND.map(|(_, f)| f * atoms.amplitude(i));
        let strip = &mut self.strip;
        let mut grams = None;
        let mut inner = |a: [usize; 2], j: usize, b: [usize; 2], grams: &Option<[[[f64; 2]; 3]; 2]>| match grams {
            Some([x, y]) => x[a[0]][b[0]] * y[a[1]][b[1]],
            None => atoms.inner(i, a, j, b, &reading.weights, strip),
        };
        for j in 0..atoms.sources() {
            if reading.weights.is_empty() && atoms.turn == 0.0 {
                grams = atoms.grams(i, j);
                if grams.is_none() {
                    continue;
                }
            }
            for (r, (second, _)) in SECOND.into_iter().enumerate() {
                if j >= n {
                    cross[r * p + 2 * n + j] = own[r] * inner(second, j, [0, 0], &grams);
                    continue;
                }
                for (c, first) in FIRST.into_iter().enumerate() {
                    let scale = if c < 2 { atoms.amplitude(j) } else { 1.0 };
                    cross[r * p + 3 * j + c] = own[r] * scale * inner(second, j, first, &grams);
                }
            }
        }
        let information =
            [0, 1, 2].map(|r| [0, 1, 2].map(|c| own[r] * own[c] * inner(SECOND[r].0, i, SECOND[c].0, &None)));
        for w in 0..widths {
            self.weighted.clone_from(&self.broadening[w]);
            for (d, w) in self.weighted.iter_mut().zip(&reading.weights) {
                *d *= w;
            }
            for (r, shared) in atoms.bend(i, &self.weighted, strip).into_iter().enumerate() {
                cross[r * p + p - widths + w] = own[r] * shared;
            }
        }
        let bend = atoms.bend(i, &self.residual, strip);
        ([0, 1, 2].map(|r| own[r] * bend[r]), information)
    }
}

struct Job<'a> {
    fitter: &'a mut Fitter,
    reading: &'a Reading,
    model: &'a Model,
    covariance: &'a [f64],
}

impl pulp::NullaryFnOnce for Job<'_> {
    type Output = Vec<Bend>;

    #[inline(always)]
    fn call(self) -> Vec<Bend> {
        self.fitter.bent(self.reading, self.model, self.covariance)
    }
}
