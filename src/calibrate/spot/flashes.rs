//! Single pixels that are bright in one frame and lie in a spot, where only the learned template shows them.

use rayon::prelude::*;

use super::learn::Learner;
use super::patch::Patch;

/// A flash is this many σ above the template and this share of the brightest light around it, and its neighbours are below half of it:
/// a template that is wrong is wrong over several pixels.
const SIGMAS: f64 = 8.0;
const SHARE: f64 = 0.1;
const NEIGHBOUR: f64 = 0.5;

/// Flashes as (index of the image, index of the pixel in it).
pub fn in_spots(learner: &Learner) -> Vec<(usize, usize)> {
    let width = learner.camera.x.n;
    let one = |patch: &Patch| -> Vec<(usize, usize)> {
        let expected = patch.expected(learner.camera, &learner.model);
        let (nx, ny) = (patch.x.len(), patch.y.len());
        let above = |j: usize, i: usize| match patch.weight[j * nx + i] > 0.0 {
            true => patch.data[j * nx + i] - expected[j * nx + i],
            false => 0.0,
        };
        let light = |j: usize, i: usize| expected[j * nx + i] - patch.background;
        let mut found = Vec::new();
        for j in 0..ny {
            for i in 0..nx {
                let own = above(j, i);
                if own < SIGMAS * learner.noise_j {
                    continue;
                }
                let around = (j.saturating_sub(1)..(j + 2).min(ny))
                    .flat_map(|b| (i.saturating_sub(1)..(i + 2).min(nx)).map(move |a| (b, a)));
                let is_single = around
                    .clone()
                    .all(|at| at == (j, i) || above(at.0, at.1) < NEIGHBOUR * own);
                let brightest = around.map(|(b, a)| light(b, a)).fold(0.0, f64::max);
                if is_single && own > SHARE * brightest {
                    found.push((patch.frame, (patch.y.start + j) * width + patch.x.start + i));
                }
            }
        }
        found
    };
    learner.patches.par_iter().flat_map_iter(one).collect()
}
