//! Single pixels that are bright in one frame and lie in a spot, where only the learned template shows them.

use super::patch::Patch;
use super::template_model::TemplateModel;
use crate::optics::Camera;

/// A flash is this many σ above the template and this share of the brightest light around it, and its neighbours are below half of it:
/// a template that is wrong is wrong over several pixels.
const SIGMAS: f64 = 8.0;
const SHARE: f64 = 0.1;
const NEIGHBOUR: f64 = 0.5;

/// Least σ of a spot, pixels: what a wrong template leaves of a narrower one may be a single pixel.
const NARROWEST: f64 = 1.0;

/// Pixels of a patch, by their places (row, column) on the sensor.
pub fn in_spots(camera: &Camera, model: &TemplateModel, noise_j: f64, patch: &Patch) -> Vec<(usize, usize)> {
    let mut found = Vec::new();
    if camera.spot_sigma_m < NARROWEST * camera.x.pitch_m.max(camera.y.pitch_m) {
        return found;
    }
    let expected = patch.expected(camera, model);
    let (nx, ny) = (patch.x.len(), patch.y.len());
    let above = |j: usize, i: usize| match patch.weight[j * nx + i] > 0.0 {
        true => patch.data[j * nx + i] - expected[j * nx + i],
        false => 0.0,
    };
    for j in 0..ny {
        for i in 0..nx {
            let own = above(j, i);
            if own < SIGMAS * noise_j {
                continue;
            }
            let around = (j.saturating_sub(1)..(j + 2).min(ny))
                .flat_map(|b| (i.saturating_sub(1)..(i + 2).min(nx)).map(move |a| (b, a)));
            let is_single = around
                .clone()
                .all(|at| at == (j, i) || above(at.0, at.1) < NEIGHBOUR * own);
            let light = around.map(|(b, a)| expected[b * nx + a] - patch.background);
            if is_single && own > SHARE * light.fold(0.0, f64::max) {
                found.push((patch.y.start + j, patch.x.start + i));
            }
        }
    }
    found
}
