//! What a template keeps to whatever the frames say: a prior that fades at the edge, a centre, a support with all its light.

use super::template_model::TemplateModel;
use crate::optics::Camera;

/// The halo that a spot error is a share of: half-width at half its height, σ. That of the estimator's noise model.
pub const HALO: f64 = 3.0;
/// Width of the margin over which the prior fades out, share of the support.
const TAPER: f64 = 0.2;

/// √Σ over the pixels of a unit-energy spot's square, about.
pub fn norm(camera: &Camera, model: &TemplateModel) -> f64 {
    let n = model.n;
    let area = model.knot_m.powi(2) / (camera.x.pitch_m * camera.y.pitch_m);
    (model.coefficients[..n * n].iter().map(|c| c * c).sum::<f64>() / area).sqrt()
}

/// Width of the Gaussian with this norm: what the estimator's halo is as wide as.
pub fn sigma_equivalent_m(camera: &Camera, model: &TemplateModel) -> f64 {
    let pixel = (camera.x.pitch_m * camera.y.pitch_m).sqrt();
    pixel / (2.0 * std::f64::consts::PI.sqrt() * norm(camera, model))
}

/// Inverse prior variances of the coefficients: three times what the template has at that distance, fading at the edge.
pub fn prior(model: &TemplateModel, is_first: bool) -> Vec<f64> {
    let n = model.n;
    let peak = model.coefficients[..n * n].iter().fold(0.0f64, |a, b| a.max(b.abs()));
    let rings = n / 2 + 2;
    let ring = |j: usize, i: usize| (model.knot(i).hypot(model.knot(j)) / model.knot_m) as usize;
    let (mut sum, mut count) = (vec![0.0; rings * 2], vec![0.0; rings * 2]);
    for j in 0..n {
        for i in 0..n {
            sum[ring(j, i)] += model.coefficients[j * n + i].powi(2);
            count[ring(j, i)] += 1.0;
        }
    }
    let floor = if is_first { 0.03 } else { 1e-3 } * peak;
    let edge = model.radius_m();
    let mut prior = Vec::with_capacity(model.coefficients.len());
    for c in 0..model.components() {
        let (_, m) = model.block(c);
        let margin = (n - m) / 2;
        let reach = edge - margin as f64 * model.knot_m;
        for j in 0..m {
            for i in 0..m {
                let (j, i) = (j + margin, i + margin);
                let k = ring(j, i);
                let rms = (sum[k] / f64::max(count[k], 1.0)).sqrt();
                let std = floor.max(3.0 * rms) * if c > 0 { 0.5 } else { 1.0 };
                let out = model.knot(i).hypot(model.knot(j));
                let t = ((reach - out) / (TAPER * reach)).clamp(0.02, 1.0);
                prior.push(1.0 / (std * t * t * (3.0 - 2.0 * t)).powi(2));
            }
        }
    }
    prior
}

/// Where light near the edge of the support is looked at, share of its radius: inside of where the prior fades.
const EDGE: [f64; 2] = [0.6, 0.8];

/// How far from the centre the template's light is that of the spots, m.
pub fn known_radius_m(model: &TemplateModel) -> f64 {
    EDGE[1] * model.radius_m()
}

/// The share of a spot's light by which it differs from a template that ends at the edge of its support: the light near the edge, as even
/// over a spot's width as a spot's own, over the halo's height there. Real tails fall no slower than the halo does beyond.
pub fn light_left_out(camera: &Camera, model: &TemplateModel) -> f64 {
    let distance = 0.5 * (EDGE[0] + EDGE[1]) * model.radius_m() / sigma_equivalent_m(camera, model);
    let height = 1.0 / (1.0 + (distance / HALO).powi(2));
    light_at_edge(camera, model) / (norm(camera, model).powi(2) * height)
}

/// Largest light of a unit-energy spot in a pixel near the edge of the support, of eight directions: a tail may point one way, and
/// the mean of many splines is free of their noise.
pub fn light_at_edge(camera: &Camera, model: &TemplateModel) -> f64 {
    let n = model.n;
    let (mut sum, mut count) = ([0.0f64; 8], [0.0f64; 8]);
    for j in 0..n {
        for i in 0..n {
            let (x, y) = (model.knot(i), model.knot(j));
            if (EDGE[0]..EDGE[1]).contains(&(x.hypot(y) / model.radius_m())) {
                let octant = usize::from(x > 0.0) + 2 * usize::from(y > 0.0) + 4 * usize::from(x.abs() > y.abs());
                sum[octant] += model.coefficients[j * n + i];
                count[octant] += 1.0;
            }
        }
    }
    let means = sum.iter().zip(count).map(|(s, c)| s.abs() / c.max(1.0));
    let pixel = camera.x.pitch_m * camera.y.pitch_m / model.knot_m.powi(2);
    pixel * means.fold(0.0, f64::max)
}

/// Brings the centroid under a Gaussian window to zero, to first order in the shift; returns the shift of places with the given field
/// values, m.
pub fn centre(model: &mut TemplateModel, sigma_m: f64) -> impl Fn(&[f64]) -> [f64; 2] + use<> {
    let n = model.n;
    let window = |x: f64, y: f64| (-0.5 * (x * x + y * y) / (sigma_m * sigma_m)).exp();
    let mut shifts = vec![[0.0; 2]; model.components()];
    let mut rate = 0.0;
    for (c, shift) in shifts.iter_mut().enumerate() {
        let (start, m) = model.block(c);
        let margin = (n - m) / 2;
        for (k, value) in model.coefficients[start..start + m * m].iter().enumerate() {
            let (x, y) = (model.knot(k % m + margin), model.knot(k / m + margin));
            let w = window(x, y) * value;
            shift[0] += w * x;
            shift[1] += w * y;
            if c == 0 {
                rate += w * (1.0 - 0.5 * (x * x + y * y) / (sigma_m * sigma_m));
            }
        }
    }
    shifts.iter_mut().flatten().for_each(|s| *s /= rate);
    let first = model.coefficients[..n * n].to_vec();
    let at = |j: usize, i: usize| if j < n && i < n { first[j * n + i] } else { 0.0 };
    let (h, components) = (model.knot_m, model.components());
    for c in 0..components {
        let (start, m) = model.block(c);
        let margin = (n - m) / 2;
        for k in 0..m * m {
            let (j, i) = (k / m + margin, k % m + margin);
            let along_x = (at(j, i + 1) - at(j, i.wrapping_sub(1))) / (2.0 * h);
            let along_y = (at(j + 1, i) - at(j.wrapping_sub(1), i)) / (2.0 * h);
            model.coefficients[start + k] += shifts[c][0] * along_x + shifts[c][1] * along_y;
        }
    }
    move |values: &[f64]| std::array::from_fn(|k| shifts.iter().zip(values).map(|(s, p)| s[k] * p).sum())
}
