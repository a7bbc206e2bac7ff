//! How much the shape may differ where no spot stood: learned from the spots of some places, it is held against those of others, as far away as
//! those that no spot was near (spatial cross-validation: Roberts et al., 2017).

use rayon::prelude::*;

use super::constraints::sigma_equivalent_m;
use super::learn::Learner;
use super::patch::Patch;
use super::statistics::{self, Variance};
use crate::optics::Axis;

/// Share of the sensor that is as near to a spot as the places that are left out, or nearer.
const SHARE: f64 = 0.8;
/// Distance, σ, within which a shape does not change: nearer spots are nowhere else.
const ALIKE: f64 = 0.75;
/// Fewest spots to learn from, and to judge.
const LEAST: usize = 20;
/// Radius around a spot that is left out within which nothing is learned, σ.
const REACH: f64 = 4.0;
const ROUNDS: usize = 6;
const STEPS: usize = 6;

/// The spot error of a shape that changes over the field at places that it was not learned from; zero where it does not, where spots stand everywhere,
/// and where there are too few.
pub fn spot_error(learner: &Learner, variance: &Variance) -> f64 {
    let sigma = sigma_equivalent_m(learner.camera, &learner.model);
    let gap = gap_m(learner);
    if !learner.model.varies() || gap < ALIKE * sigma {
        return 0.0;
    }
    // Cells of a chessboard, whose middles are as far from the others' spots.
    let cell = |v: f64| (v / (2.0 * gap)).floor() as i64;
    let is_black = |at: [f64; 2]| (cell(at[0]) + cell(at[1])).rem_euclid(2) == 0;
    let black = places(learner).filter(|at| is_black(*at)).count();
    if black.min(learner.sources() - black) < LEAST {
        return 0.0;
    }
    let error = |is_left_out: &(dyn Fn(usize, [f64; 2]) -> bool + Sync)| {
        let patches = learner.patches.par_iter();
        let patches = patches.map(|patch| without(learner, patch, REACH * sigma, |at| is_left_out(patch.frame, at)));
        let mut others = learner.of_patches(patches.filter(|patch| !patch.sources.is_empty()).collect());
        for _ in 0..ROUNDS {
            others.fit(STEPS);
            others.step(false);
        }
        statistics::spot_error_at(&learner.refitted(others.model), variance, is_left_out)
    };
    let elsewhere = error(&|_, at| is_black(at)).max(error(&|_, at| !is_black(at)));
    // Half of the spots tell less.
    let half = error(&|frame, at| (frame % 2 == 0) == is_black(at));
    (elsewhere.powi(2) - half.powi(2)).max(0.0).sqrt()
}

fn places<'a>(learner: &'a Learner) -> impl Iterator<Item = [f64; 2]> + 'a {
    learner
        .patches
        .iter()
        .flat_map(|patch| &patch.sources)
        .map(|source| source.at)
}

/// Distance of the nearest spot from most of the sensor, m.
fn gap_m(learner: &Learner) -> f64 {
    let camera = learner.camera;
    let spots: Vec<[f64; 2]> = places(learner).collect();
    let centres = |axis: &Axis| (0..axis.n).step_by(2).map(|k| axis.centre(k)).collect::<Vec<f64>>();
    let (columns, rows) = (centres(&camera.x), centres(&camera.y));
    let nearest = |x: f64, y: f64| {
        let distances = spots.iter().map(|at| (at[0] - x).powi(2) + (at[1] - y).powi(2));
        distances.fold(f64::INFINITY, f64::min).sqrt()
    };
    let of_row = |y: &f64| columns.iter().map(|x| nearest(*x, *y)).collect::<Vec<f64>>();
    let mut distances: Vec<f64> = rows.par_iter().flat_map_iter(of_row).collect();
    let k = (SHARE * (distances.len() - 1) as f64) as usize;
    *distances.select_nth_unstable_by(k, f64::total_cmp).1
}

/// A patch without the spots that are left out, and what is near them.
fn without(learner: &Learner, patch: &Patch, reach_m: f64, is_left_out: impl Fn([f64; 2]) -> bool) -> Patch {
    let mut left_out = patch.clone();
    left_out.sources.retain(|source| is_left_out(source.at));
    let light = left_out.expected(learner.camera, &learner.model);
    let mut kept = patch.clone();
    kept.sources.retain(|source| !is_left_out(source.at));
    kept.data
        .iter_mut()
        .zip(light)
        .for_each(|(value, light)| *value -= light - patch.background);
    for source in &left_out.sources {
        for p in patch.near(learner.camera, source.at, reach_m) {
            kept.weight[p] = 0.0;
        }
    }
    kept
}
