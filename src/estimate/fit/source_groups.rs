//! Source grouping: groups that no longer move are subtracted from the frame, and only the active set is fitted on.

use crate::estimate::fit::damped_step::Step;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, INDEPENDENT, Nuisances, PointSource};
use crate::estimate::model::separable_model::SeparableModel;

/// A source is at rest when its squared step over the step's variance is below this: a tenth of a standard deviation, which the joint fit
/// that follows takes up.
const AT_REST: f64 = 1e-2;
/// Fewest sources for which grouping pays: below, restricting the frame costs as much as a step.
const MIN_SOURCES: usize = 4;

/// The sources in groups that can be fitted separately (single linkage); `None` where there is one group, or parameters are shared.
pub(crate) fn source_groups(hypothesis: &Hypothesis) -> Option<Vec<Vec<usize>>> {
    let sources = &hypothesis.sources;
    if sources.len() < MIN_SOURCES
        || hypothesis.nuisances != Nuisances::default()
        || sources.iter().any(|s| s.power.is_some())
    {
        return None;
    }
    let groups = linked(sources, INDEPENDENT);
    (groups.len() > 1).then_some(groups)
}

/// The sources in groups of which each is nearer than this, σ, to another of its group.
pub(crate) fn linked(sources: &[PointSource], distance: f64) -> Vec<Vec<usize>> {
    let is_linked = |i: usize, j: usize| {
        let d = [0, 1].map(|k| sources[i].u[k] - sources[j].u[k]);
        d[0].hypot(d[1]) < distance
    };
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for i in 0..sources.len() {
        let (linked, mut apart): (Vec<_>, Vec<_>) = groups
            .into_iter()
            .partition(|g: &Vec<usize>| g.iter().any(|&j| is_linked(i, j)));
        let mut group = linked.concat();
        group.push(i);
        apart.push(group);
        groups = apart;
    }
    groups
}

/// Each such group as one source: its centroid and its light.
pub(crate) fn merged(sources: &[PointSource], distance: f64) -> Vec<PointSource> {
    let as_one = |group: &Vec<usize>| {
        let light: f64 = group.iter().map(|&i| sources[i].a).sum();
        let u = [0, 1].map(|k| group.iter().map(|&i| sources[i].a * sources[i].u[k]).sum::<f64>() / light);
        PointSource::new(u, light)
    };
    linked(sources, distance).iter().map(as_one).collect()
}

/// The sources of groups that a step moved; `None` where that is none, and where they are more than half of all. Only without nuisances.
pub(crate) fn active_set(groups: &[Vec<usize>], step: &Step, equations: &NormalEquations) -> Option<Vec<usize>> {
    let (n, p) = (equations.sources, equations.parameters);
    let is_active = |i: usize| {
        let along = |k: usize| equations.information[(3 * i + k) * (p + 1)] * step.velocity[3 * i + k].powi(2);
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

/// `compressed` less all sources of a model but those at `kept`.
pub(crate) fn restrict_frame(
    compressed: &CompressedFrame,
    bases: &Bases,
    model: &SeparableModel,
    kept: &[usize],
) -> CompressedFrame {
    let mut subset = compressed.clone();
    for i in (0..model.sources.len()).filter(|i| !kept.contains(i)) {
        model.accumulate(i, 0, 0, -model.amplitude(i), &mut subset.coefficients);
    }
    subset.update_weighted(bases.axes());
    subset
}

/// The sources of `hypothesis` at `kept`.
pub(crate) fn restrict_hypothesis(hypothesis: &Hypothesis, kept: &[usize]) -> Hypothesis {
    Hypothesis {
        sources: kept.iter().map(|&i| hypothesis.sources[i]).collect(),
        ..hypothesis.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::model::hypothesis::{Background, PointSource};

    #[test]
    fn chains_of_close_sources_are_groups_and_only_the_moving_ones_are_active() {
        let mut hypothesis = Hypothesis::empty(Nuisances::default());
        // 0, 2 and 3 are a chain 3 σ apart; 1 and 4 stand alone.
        let at = [[0.0, 0.0], [20.0, 0.0], [3.0, 0.0], [3.0, 3.0], [-20.0, 5.0]];
        hypothesis.sources = at.map(|u| PointSource::new(u, 100.0)).to_vec();
        let mut groups = source_groups(&hypothesis).expect("several groups");
        for group in &mut groups {
            group.sort_unstable();
        }
        groups.sort();
        assert_eq!(groups, [vec![0, 2, 3], vec![1], vec![4]]);
        let information = (0..225).map(|k| if k % 16 == 0 { 100.0 } else { 0.0 });
        let equations = NormalEquations::of_sources(information.collect());
        let mut step = Step {
            velocity: vec![1e-3; 15],
            ..Step::default()
        };
        assert_eq!(active_set(&groups, &step, &equations), None, "all are at rest");
        // A tenth of a standard deviation along y.
        step.velocity[3 * 4 + 1] = 1.1e-2;
        assert_eq!(active_set(&groups, &step, &equations), Some(vec![4]));
        step.velocity[3 * 2] = 1.1e-2;
        assert_eq!(active_set(&groups, &step, &equations), None, "more than half move");
        hypothesis.sources[0].u = [0.0, -20.0];
        hypothesis.nuisances.background = Background::Plane;
        assert_eq!(source_groups(&hypothesis), None, "a background is shared");
    }
}
