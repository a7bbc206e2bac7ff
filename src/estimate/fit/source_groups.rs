//! The emitters that still move, fitted alone: groups of others, at rest meanwhile and far from them, are taken out of the frame.

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot};

/// A spot is at rest when the square of a step, over its variance, is below this.
const REST: f64 = 1e-2;
/// Emitters from which on a fit is worth parting.
const FEWEST: usize = 4;
/// Spots nearer than this, σ, move together.
const TIED: f64 = 4.0;

impl Model {
    /// Its emitters in groups that can be fitted one without the other; `None` where they cannot.
    pub(crate) fn groups(&self) -> Option<Vec<Vec<usize>>> {
        let n = self.spots.len();
        if n < FEWEST || self.nuisances != Nuisances::default() || self.spots.iter().any(|s| s.power.is_some()) {
            return None;
        }
        let is_tied = |i: usize, j: usize| {
            let d = [0, 1].map(|k| self.spots[i].u[k] - self.spots[j].u[k]);
            d[0].hypot(d[1]) < TIED
        };
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for i in 0..n {
            let (tied, mut apart): (Vec<_>, Vec<_>) = groups
                .into_iter()
                .partition(|g: &Vec<usize>| g.iter().any(|&j| is_tied(i, j)));
            let mut group = tied.concat();
            group.push(i);
            apart.push(group);
            groups = apart;
        }
        (groups.len() > 1).then_some(groups)
    }
}

impl Fitter {
    /// The spots of groups that the last step moved, where they are no more than half of all; `None` also without a step.
    pub(crate) fn moving(&self, groups: &[Vec<usize>]) -> Option<Vec<usize>> {
        let n = self.now.spots.len();
        if self.velocity.len() != 3 * n {
            return None;
        }
        let is_moving = |i: usize| {
            let along = |k: usize| self.hessian[(3 * i + k) * (3 * n + 1)] * self.velocity[3 * i + k].powi(2);
            !(along(0) + along(1) < REST)
        };
        let moving: Vec<usize> = groups
            .iter()
            .filter(|g| g.iter().any(|&i| is_moving(i)))
            .flatten()
            .copied()
            .collect();
        (!moving.is_empty() && 2 * moving.len() <= n).then_some(moving)
    }

    /// What `reading` shows of the spots at `kept`, without the others of the present hypothesis.
    pub(crate) fn part(&self, reading: &Reading, kept: &[usize]) -> Reading {
        let mut part = reading.clone();
        for i in (0..self.now.spots.len()).filter(|i| !kept.contains(i)) {
            let amplitude = self.now.amplitude(i);
            self.now.add(i, 0, 0, -amplitude, &mut part.z);
        }
        part.reweight([&self.bx, &self.by]);
        part
    }
}

/// The spots of `model` at `kept`.
pub(crate) fn only(model: &Model, kept: &[usize]) -> Model {
    let spots: Vec<Spot> = kept.iter().map(|&i| model.spots[i]).collect();
    Model { spots, ..model.clone() }
}
