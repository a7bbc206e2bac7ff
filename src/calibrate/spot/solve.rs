//! One step of the template: all its coefficients at once, by conjugate gradients on the normal equations.

use rayon::prelude::*;

use super::constraints;
use super::patch::{Buffers, Linearised, Patch};
use super::template_model::TemplateModel;
use crate::optics::Camera;

/// Largest number of steps of conjugate gradients. The outer iteration continues where one was cut short.
const STEPS: usize = 30;
/// Relative fall of the residual at which a solution is accurate enough for the outer iteration.
const ACCURACY: f64 = 3e-4;

/// Patches whose gradients one thread adds up.
const CHUNK: usize = 32;

/// A patch with its Jacobian at the present state; none where its own parameters are not determined.
type Linear<'a> = Vec<(&'a Patch, Linearised)>;

/// One step of the template and of everything else at once.
pub fn step(camera: &Camera, model: &mut TemplateModel, patches: &mut [Patch], is_first: bool) {
    let prior = constraints::prior(model, is_first);
    let linear: Linear = patches
        .par_iter()
        .filter_map(|patch| patch.linearise(camera, model).map(|l| (patch, l)))
        .collect();
    let step = template_step(model, &linear, &prior);
    drop(linear);
    model.coefficients.iter_mut().zip(&step).for_each(|(c, s)| *c += s);
    let shift = constraints::centre(model, camera.spot_sigma_m);
    let light = model.normalise();
    for source in patches.iter_mut().flat_map(|patch| &mut patch.sources) {
        let values = model.field_values(source.at);
        source.energy_j *= light(&values);
        let moved = shift(&values);
        (0..2).for_each(|k| source.at[k] += moved[k]);
    }
}

/// Change δ of the coefficients that minimises Σ_patches ‖P(r − D δ)‖² + ‖(c + δ)/τ‖², where P removes what places, energies and
/// backgrounds explain (variable projection: Kaufman, 1975), so that the alternation of places and template takes a few rounds
/// instead of dozens. `prior` holds 1/τ².
fn template_step(model: &TemplateModel, patches: &Linear, prior: &[f64]) -> Vec<f64> {
    let n = model.coefficients.len();
    let over_patches = |image: &(dyn Fn(&Patch, &Linearised, &mut Buffers) -> Vec<f64> + Sync)| -> Vec<f64> {
        let of_chunk = |chunk: &[(&Patch, Linearised)]| {
            let (mut gradient, mut buffers) = (vec![0.0; n], Buffers::default());
            for (patch, linear) in chunk {
                let mut weighted = image(patch, linear, &mut buffers);
                linear.project(patch, &mut weighted);
                linear.gradient(patch, model, &mut weighted, &mut buffers, &mut gradient);
            }
            gradient
        };
        // Added up in their order, so that the same frames always give the same calibration.
        let gradients: Vec<Vec<f64>> = patches.par_chunks(CHUNK).map(of_chunk).collect();
        gradients.iter().fold(vec![0.0; n], |mut sum, gradient| {
            sum.iter_mut().zip(gradient).for_each(|(s, g)| *s += g);
            sum
        })
    };
    let apply = |v: &[f64]| -> Vec<f64> {
        let mut out = over_patches(&|patch, linear, buffers| linear.template_change(patch, model, v, buffers));
        out.iter_mut().zip(v).zip(prior).for_each(|((o, v), p)| *o += p * v);
        out
    };
    let mut residual = over_patches(&|_, linear, _| linear.residual.clone());
    for ((r, c), p) in residual.iter_mut().zip(&model.coefficients).zip(prior) {
        *r -= p * c;
    }
    let scale = diagonal(model, patches, prior);
    let precondition = |r: &[f64]| -> Vec<f64> { r.iter().zip(&scale).map(|(r, s)| r / s).collect() };
    let mut solution = vec![0.0; n];
    let mut z = precondition(&residual);
    let mut direction = z.clone();
    let mut rho = dot(&residual, &z);
    let first = rho;
    for _ in 0..STEPS {
        if !(rho > ACCURACY * ACCURACY * first) {
            break;
        }
        let image = apply(&direction);
        let alpha = rho / dot(&direction, &image);
        for k in 0..n {
            solution[k] += alpha * direction[k];
            residual[k] -= alpha * image[k];
        }
        z = precondition(&residual);
        let next = dot(&residual, &z);
        let beta = next / rho;
        rho = next;
        direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + beta * *d);
    }
    solution
}

/// Diagonal of the normal equations as it would be if every spline were seen by whole pixels, with the prior.
fn diagonal(model: &TemplateModel, patches: &Linear, prior: &[f64]) -> Vec<f64> {
    let components = model.components();
    let mut seen = vec![0.0; components];
    for (patch, linear) in patches {
        let weight = patch.weight.iter().map(|w| w * w).sum::<f64>() / patch.pixels() as f64;
        for (source, values) in patch.sources.iter().zip(linear.field_values()) {
            for (s, p) in seen.iter_mut().zip(values) {
                *s += weight * (p * source.energy_j).powi(2);
            }
        }
    }
    let mut out = Vec::with_capacity(prior.len());
    for (c, seen) in seen.iter().enumerate() {
        let (start, m) = model.block(c);
        out.extend(prior[start..start + m * m].iter().map(|p| p + PER_SPLINE * seen));
    }
    out
}

/// Σ over pixels of (∫ of a spline over the pixel)², knots half a pixel apart: (151/315·½)², the scale alone.
const PER_SPLINE: f64 = 0.06;

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
