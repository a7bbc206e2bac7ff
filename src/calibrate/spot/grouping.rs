//! Groups the spots of a frame whose light overlaps and cuts the frame into patches.

use std::ops::Range;

use super::band::pixels_within;
use super::patch::{Patch, Source};
use super::template_model::TemplateModel;
use crate::optics::Camera;

/// One frame prepared for learning, J, row by row.
#[derive(Clone, Debug)]
pub struct Image {
    /// Finite everywhere.
    pub pixels: Vec<f64>,
    /// 1/σ of a pixel, 1/J; zero where it is not used.
    pub weight: Vec<f64>,
    /// Median of the used pixels, J.
    pub level: f64,
}

/// Patches of a frame: each holds the spots whose windows of half-width `radius_m` overlap, directly or through others.
pub fn patches(camera: &Camera, index: usize, image: &Image, sources: Vec<Source>, radius_m: f64) -> Vec<Patch> {
    let mut boxes: Vec<([Range<usize>; 2], Vec<Source>)> = Vec::new();
    for source in sources {
        let mut window = [
            pixels_within(&camera.x, source.at[0], radius_m),
            pixels_within(&camera.y, source.at[1], radius_m),
        ];
        let mut members = vec![source];
        // A larger box may touch boxes that the smaller one did not.
        while let Some(k) = boxes.iter().position(|(other, _)| overlap(other, &window)) {
            let (other, more) = boxes.swap_remove(k);
            for (a, b) in window.iter_mut().zip(other) {
                *a = a.start.min(b.start)..a.end.max(b.end);
            }
            members.extend(more);
        }
        if window.iter().all(|r| !r.is_empty()) {
            boxes.push((window, members));
        }
    }
    let nx = camera.x.n;
    let cut = |values: &[f64], [x, y]: &[Range<usize>; 2]| -> Vec<f64> {
        let rows = y.clone().flat_map(|j| values[j * nx + x.start..j * nx + x.end].iter());
        rows.copied().collect()
    };
    boxes
        .into_iter()
        .map(|(window, sources)| Patch {
            frame: index,
            data: cut(&image.pixels, &window),
            weight: cut(&image.weight, &window),
            x: window[0].clone(),
            y: window[1].clone(),
            sources,
            background: image.level,
            chi2: 0.0,
        })
        .collect()
}

/// What the patches of an image leave of it, J; between them its level is taken off.
pub fn residual(camera: &Camera, model: &TemplateModel, image: &Image, patches: &[&Patch]) -> Vec<f64> {
    let nx = camera.x.n;
    let mut residual: Vec<f64> = image.pixels.iter().map(|v| v - image.level).collect();
    for patch in patches {
        let expected = patch.expected(camera, model);
        for (row, line) in patch.y.clone().zip(expected.chunks_exact(patch.x.len())) {
            let start = row * nx + patch.x.start;
            for (o, e) in residual[start..].iter_mut().zip(line) {
                *o += image.level - e;
            }
        }
    }
    residual
}

fn overlap(a: &[Range<usize>; 2], b: &[Range<usize>; 2]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.start < b.end && b.start < a.end)
}
