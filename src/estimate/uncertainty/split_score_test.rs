//! How a spot is bent: what the residual says of a second moment that one emitter does not have. Two emitters too near to be told
//! apart look like one whose light is spread along the line between them, so this is the score test of a split (Rao, 1948), with
//! all that the model would adjust taken out.

use crate::estimate::dense_linalg::{axpy, dot};
use crate::estimate::emitter::Bend;
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Model;
use crate::estimate::model::separable_model::Atoms;

/// The derivatives that go with the second moments xx, xy, yy, and what multiplies them: a spot spread by M changes by
/// ½A(M_xx f_xx + 2 M_xy f_xy + M_yy f_yy).
const SECOND: [([usize; 2], f64); 3] = [([2, 0], 0.5), ([1, 1], 1.0), ([0, 2], 0.5)];
/// Directions that are looked in, over half a turn.
const DIRECTIONS: usize = 16;
/// A direction of which less than this share is left beside what the model adjusts says nothing.
const LEAST: f64 = 1e-6;

/// A split that a bend asks for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Split {
    /// Drop of the deviance that it promises, to second order.
    pub gain: f64,
    pub index: usize,
    pub direction: [f64; 2],
    /// How far to either side equal halves would lie, σ.
    pub distance: f64,
}

impl Bend {
    /// The split along the direction that gains most, if any gains.
    pub(crate) fn split(&self, index: usize) -> Option<Split> {
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
        self.work += (model.spots.len() * p * 3 * p) as f64;
        let (mut cross, mut taken) = (vec![0.0; 3 * p], vec![0.0; 3 * p]);
        let mut bends = Vec::with_capacity(model.spots.len());
        for i in 0..model.spots.len() {
            cross.fill(0.0);
            let (mut score, mut information) = self.raw_bend(reading, i, widths, &mut cross);
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

    /// Score and information of spot `i`'s second moments, and what they share with the model's parameters, (3, p).
    #[inline(always)]
    fn raw_bend(&mut self, reading: &Reading, i: usize, widths: usize, cross: &mut [f64]) -> ([f64; 3], [[f64; 3]; 3]) {
        let p = cross.len() / 3;
        let atoms: &Atoms = &self.now;
        let own = SECOND.map(|(_, f)| f * atoms.amplitude(i));
        let strip = &mut self.strip;
        let mut information = [[0.0; 3]; 3];
        if reading.weights.is_empty() && reading.bad.runs().is_empty() && widths == 0 && atoms.turn == 0.0 {
            for (r, (second, _)) in SECOND.into_iter().enumerate() {
                for (c, (other, _)) in SECOND.into_iter().enumerate() {
                    information[r][c] = own[r] * own[c] * atoms.inner(i, second, i, other, &[], strip);
                }
            }
            share(atoms, i, own, cross);
            self.velocity.resize(p, 0.0);
            for bad in reading.bad.scattered() {
                let at = atoms.at(i, [bad.x, bad.y], SECOND.map(|(second, _)| second));
                if at == [0.0; 3] {
                    continue;
                }
                atoms.slopes_at([bad.x, bad.y], &mut self.velocity);
                for r in 0..3 {
                    axpy(-own[r] * at[r], &self.velocity, &mut cross[r * p..(r + 1) * p]);
                    for c in 0..3 {
                        information[r][c] -= own[r] * at[r] * own[c] * at[c];
                    }
                }
            }
        } else {
            for (r, (second, _)) in SECOND.into_iter().enumerate() {
                self.bend.clear();
                self.bend.resize(reading.mx * reading.my, 0.0);
                atoms.add(i, second[0], second[1], own[r], &mut self.bend);
                reading.weight(&mut self.bend, [&self.bx, &self.by], false, &mut self.scratch);
                let row = &mut cross[r * p..(r + 1) * p];
                atoms.slopes(&self.bend, strip, row);
                for w in 0..widths {
                    row[p - widths + w] = dot(&self.bend, &self.broadening[w]);
                }
                let bend = atoms.bend(i, &self.bend, strip);
                for c in 0..3 {
                    information[r][c] = own[c] * bend[c];
                }
            }
        }
        let bend = atoms.bend(i, &self.residual, strip);
        ([0, 1, 2].map(|r| own[r] * bend[r]), information)
    }
}

/// What spot `i`'s second moments share with all sources in an unweighted frame, (3, p).
#[inline(always)]
fn share(atoms: &Atoms, i: usize, own: [f64; 3], cross: &mut [f64]) {
    let (n, p) = (atoms.spots.len(), cross.len() / 3);
    for j in 0..atoms.sources() {
        let Some([x, y]) = atoms.grams(i, j) else { continue };
        for (r, (second, _)) in SECOND.into_iter().enumerate() {
            let along = |first: [usize; 2]| own[r] * x[second[0]][first[0]] * y[second[1]][first[1]];
            if j >= n {
                cross[r * p + 2 * n + j] = along([0, 0]);
                continue;
            }
            let a = atoms.amplitude(j);
            cross[r * p + 3 * j] = a * along([1, 0]);
            cross[r * p + 3 * j + 1] = a * along([0, 1]);
            cross[r * p + 3 * j + 2] = along([0, 0]);
        }
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
