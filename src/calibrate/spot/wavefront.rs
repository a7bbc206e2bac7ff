//! Finds the wavefront of a lens from the spots that it makes, without knowing their places.

use faer::Mat;
use rayon::prelude::*;

use super::patch::{Buffers, Patch};
use super::pupil::Pupil;
use super::template_model::TemplateModel;
use crate::calibrate::exposure::ScaledCholesky;
use crate::optics::Camera;

/// Standard deviation of every parameter about zero, waves or radii of the aperture: what the spots do not tell stays small. The width is free.
const PRIOR: f64 = 0.3;
/// Patches that are used for one step, at most: they determine fifty parameters, and more take longer.
const MOST_PATCHES: usize = 400;
/// Longest step, waves or ln of the width.
const LONGEST: f64 = 0.15;
const DAMPING: f64 = 1e-4;
/// Times that a step is halved until it lowers χ².
const HALVINGS: usize = 5;
/// Steps of the places within one of the wavefront.
const PLACES: usize = 4;

/// One step of Gauss and Newton of the wavefront, places, energies and backgrounds projected out (variable projection: Kaufman, 1975).
/// Returns the new model; none where no step explains the spots better.
pub fn step(camera: &Camera, model: &TemplateModel, pupil: Pupil, patches: &[Patch]) -> Option<TemplateModel> {
    let stride = patches.len().div_ceil(MOST_PATCHES).max(1);
    let patches: Vec<&Patch> = patches.iter().step_by(stride).collect();
    let changes = model.pupil_changes(&pupil);
    // Added up in their order, so that the same frames always give the same calibration.
    let normals: Vec<(Mat<f64>, Vec<f64>)> = patches
        .par_iter()
        .filter_map(|patch| normal(camera, model, &pupil, patch, &changes))
        .collect();
    let mut h = Mat::<f64>::zeros(Pupil::PARAMETERS, Pupil::PARAMETERS);
    let mut g = vec![0.0; Pupil::PARAMETERS];
    for (of_h, of_g) in &normals {
        h += of_h;
        g.iter_mut().zip(of_g).for_each(|(g, v)| *g += v);
    }
    for k in 1..Pupil::PARAMETERS {
        h[(k, k)] += PRIOR.powi(-2);
        g[k] -= pupil.parameters[k] * PRIOR.powi(-2);
    }
    for k in (0..Pupil::PARAMETERS).filter(|k| !pupil.is_free(*k)) {
        (0..Pupil::PARAMETERS).for_each(|l| (h[(k, l)], h[(l, k)]) = (0.0, 0.0));
        (h[(k, k)], g[k]) = (1.0, 0.0);
    }
    let mut step = ScaledCholesky::new(&h, DAMPING)?.solve(&g);
    let longest = step.iter().fold(0.0, |a: f64, s| a.max(s.abs()));
    if longest > LONGEST {
        step.iter_mut().for_each(|s| *s *= LONGEST / longest);
    }
    let cost = |model: &TemplateModel, pupil: &Pupil| -> f64 {
        let fitted = patches.par_iter().map(|patch| {
            let mut patch = (*patch).clone();
            patch.fit(camera, model, PLACES);
            patch.chi2
        });
        let chi2: Vec<f64> = fitted.collect();
        chi2.iter().sum::<f64>() + pupil.parameters[1..].iter().map(|p| (p / PRIOR).powi(2)).sum::<f64>()
    };
    let now = cost(model, &pupil);
    for _ in 0..HALVINGS {
        let mut next = pupil;
        next.parameters.iter_mut().zip(&step).for_each(|(p, s)| *p += s);
        let template = model.with_pupil(next);
        if cost(&template, &next) < now {
            return Some(template);
        }
        step.iter_mut().for_each(|s| *s *= 0.5);
    }
    None
}

/// Normal equations of one patch.
fn normal(
    camera: &Camera,
    model: &TemplateModel,
    pupil: &Pupil,
    patch: &Patch,
    changes: &[Vec<f64>],
) -> Option<(Mat<f64>, Vec<f64>)> {
    let linear = patch.linearise(camera, model)?;
    let mut columns = Mat::<f64>::zeros(patch.pixels(), Pupil::PARAMETERS);
    let mut buffers = Buffers::default();
    for (i, source) in patch.sources.iter().enumerate() {
        let (place, _) = model.field.at(source.at);
        for (k, change) in changes.iter().enumerate().filter(|(k, _)| pupil.may_change(*k)) {
            let mut image = vec![0.0; patch.pixels()];
            linear.source_change(patch, model, i, change, &mut buffers, &mut image);
            for (c, factor) in Pupil::range(k).zip(Pupil::factors(place)) {
                let column = columns.col_as_slice_mut(c);
                column.iter_mut().zip(&image).for_each(|(c, v)| *c += factor * v);
            }
        }
    }
    for c in (0..Pupil::PARAMETERS).filter(|c| pupil.is_free(*c)) {
        let column = columns.col_as_slice_mut(c);
        column.iter_mut().zip(&patch.weight).for_each(|(c, w)| *c *= w);
        linear.project(patch, column);
    }
    let mut residual = linear.residual.clone();
    linear.project(patch, &mut residual);
    let gradient = (0..Pupil::PARAMETERS)
        .map(|c| columns.col_as_slice(c).iter().zip(&residual).map(|(c, r)| c * r).sum())
        .collect();
    Some((columns.transpose() * &columns, gradient))
}
