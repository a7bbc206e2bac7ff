//! Source grouping: groups that no longer move are subtracted from the frame, and only the active set is fitted on.

use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};

/// A source is at rest when its squared step over the step's variance is below this.
const AT_REST: f64 = 1e-2;
/// Fewest sources for which grouping pays.
const MIN_SOURCES: usize = 4;
/// Sources within this distance, σ, belong to one group.
const GROUP_DISTANCE: f64 = 4.0;

impl Hypothesis {
    /// The sources in groups that can be fitted separately (single linkage); `None` where there is one group, or parameters are shared.
    pub(crate) fn source_groups(&self) -> Option<Vec<Vec<usize>>> {
        let n = self.sources.len();
        if n < MIN_SOURCES || self.nuisances != Nuisances::default() || self.sources.iter().any(|s| s.power.is_some()) {
            return None;
        }
        let is_linked = |i: usize, j: usize| {
            let d = [0, 1].map(|k| self.sources[i].u[k] - self.sources[j].u[k]);
            d[0].hypot(d[1]) < GROUP_DISTANCE
        };
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for i in 0..n {
            let (linked, mut apart): (Vec<_>, Vec<_>) = groups
                .into_iter()
                .partition(|g: &Vec<usize>| g.iter().any(|&j| is_linked(i, j)));
            let mut group = linked.concat();
            group.push(i);
            apart.push(group);
            groups = apart;
        }
        (groups.len() > 1).then_some(groups)
    }
}

impl Fitter {
    /// The sources of groups that the last step moved; `None` without a step, and where they are more than half of all.
    pub(crate) fn active_set(&self, groups: &[Vec<usize>]) -> Option<Vec<usize>> {
        let n = self.current.sources.len();
        if self.velocity.len() != 3 * n {
            return None;
        }
        let is_active = |i: usize| {
            let along = |k: usize| self.hessian[(3 * i + k) * (3 * n + 1)] * self.velocity[3 * i + k].powi(2);
            !(along(0) + along(1) < AT_REST)
        };
        let active: Vec<usize> = groups
            .iter()
            .filter(|g| g.iter().any(|&i| is_active(i)))
            .flatten()
            .copied()
            .collect();
        (!active.is_empty() && 2 * active.len() <= n).then_some(active)
    }

    /// `compressed` less all sources of the current model but those at `kept`.
    pub(crate) fn restrict_frame(&self, compressed: &CompressedFrame, kept: &[usize]) -> CompressedFrame {
        let mut subset = compressed.clone();
        for i in (0..self.current.sources.len()).filter(|i| !kept.contains(i)) {
            let amplitude = self.current.amplitude(i);
            self.current.accumulate(i, 0, 0, -amplitude, &mut subset.coefficients);
        }
        subset.update_weighted([&self.bx, &self.by]);
        subset
    }
}

/// The sources of `hypothesis` at `kept`.
pub(crate) fn restrict_hypothesis(hypothesis: &Hypothesis, kept: &[usize]) -> Hypothesis {
    let sources: Vec<PointSource> = kept.iter().map(|&i| hypothesis.sources[i]).collect();
    Hypothesis {
        sources,
        ..hypothesis.clone()
    }
}
