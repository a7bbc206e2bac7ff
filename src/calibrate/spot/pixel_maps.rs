//! Gain, dark level and bad pixels of frames whose spots were learned.

use ndarray::Array2;
use rayon::prelude::*;

use super::band::pixels_within;
use super::grouping::Image;
use super::learn::{Learner, Odd};
use super::patch::Patch;
use super::prepare::Prepared;
use super::template_model::TemplateModel;
use crate::calibrate::maps::{self, Pixels};
use crate::optics::{Axis, Camera, PixelMaps};
use crate::stats::median;

/// Pixel maps that a recording leads to.
pub struct Found {
    /// None where the pixels are alike.
    pub maps: Option<PixelMaps>,
    /// Whether they are better than the camera's.
    pub are_better: bool,
}

/// Passes over the frames: two show what a bad pixel that was taken for a spot has hidden, more what those around it have.
const PASSES: usize = 3;

/// The maps of all frames with the spots' shape held fixed, `misfit` being what it leaves of them; anew where bad pixels were taken for spots.
pub fn of_frames(
    camera: &Camera,
    prepared: &mut Prepared,
    model: &TemplateModel,
    misfit: f64,
    is_held: impl Fn(usize) -> bool + Sync,
    better: f64,
) -> Found {
    let once = |prepared: &Prepared| {
        let images: Vec<&Image> = prepared.images.iter().collect();
        let mut learner = Learner::with_model(camera, &images, prepared.noise_j, model, misfit);
        let odd = learner.mask_odd();
        learner.fit(6);
        estimate(&learner, &odd, &prepared.hot, &is_held, better)
    };
    let mut found = once(prepared);
    for _ in 1..PASSES {
        if !prepared.mask_bad(found.maps.as_ref()) {
            break;
        }
        found = once(prepared);
    }
    found
}

/// The camera's maps with what is better: gains and dark levels are replaced where those of the other frames lower the χ² of the
/// held-out ones by more than `better`. `odd` are spots that the learner's template does not explain: what it leaves there says
/// nothing about the pixels. `hot` are pixels known to be bad.
fn estimate(
    learner: &Learner,
    odd: &[Odd],
    hot: &[usize],
    is_held: impl Fn(usize) -> bool + Sync,
    better: f64,
) -> Found {
    let shape = learner.camera.shape();
    let ideal = PixelMaps::ideal(shape);
    let own = learner.camera.pixels.as_deref().unwrap_or(&ideal);
    let frames = expected(learner, odd);
    let unknown = unknown(learner, &frames);
    let from = |frames: Vec<Pixels>| maps::estimate_from(shape, learner.noise_j, frames.into_iter());
    let indexed = frames.iter().enumerate();
    let others = indexed.filter(|(k, _)| !is_held(*k)).map(|(_, f)| f.clone()).collect();
    let (Some(mut trial), Some(mut found)) = (from(others), from(frames)) else {
        return Found {
            maps: learner.camera.pixels.as_deref().cloned(),
            are_better: false,
        };
    };
    for maps in [&mut trial, &mut found] {
        spare_spots(learner.camera, maps, own);
    }
    let nx = learner.camera.x.n;
    for p in bright_beside(learner, &unknown) {
        found.bad[(p / nx, p % nx)] = true;
    }
    hot.iter().for_each(|p| found.bad[(p / nx, p % nx)] = true);
    found.bad.zip_mut_with(&own.bad, |new, old| *new |= *old);

    // Bad pixels are left out of every sum.
    let held: Vec<Patch> = learner.patches.iter().filter(|p| is_held(p.frame)).cloned().collect();
    let chi2 = |gain: &Array2<f64>, dark_j: &Array2<f64>| {
        let maps = PixelMaps {
            gain: gain.clone(),
            dark_j: dark_j.clone(),
            bad: found.bad.clone(),
        };
        chi2(learner, &held, &maps)
    };
    let least = chi2(&own.gain, &own.dark_j);
    let with_dark = chi2(&own.gain, &trial.dark_j);
    let has_dark = least - with_dark > better;
    let (dark_j, least) = match has_dark {
        true => (&trial.dark_j, with_dark),
        false => (&own.dark_j, least),
    };
    let has_gain = least - chi2(&trial.gain, dark_j) > better;
    if !has_gain {
        found.gain = own.gain.clone();
    }
    if !has_dark {
        found.dark_j = own.dark_j.clone();
    }
    let are_better = has_gain || has_dark || found.bad != own.bad;
    Found {
        maps: (found != ideal).then_some(found),
        are_better,
    }
}

/// Pixels around what is odd in every frame, such as two hot ones that are taken for a spot, and their median light, J: of most nothing is
/// known, the brightest are the reason.
fn unknown(learner: &Learner, frames: &[Pixels]) -> Vec<(usize, f64)> {
    let pixels = 0..frames.first().map_or(0, |f| f.used.len());
    let usable = |p: usize| learner.images.iter().filter(move |i| i.weight[p] > 0.0);
    let light = |p: usize| median(usable(p).map(|i| i.pixels[p] - i.level).collect());
    let is_unknown = |p: &usize| !frames.iter().any(|f| f.used[*p]);
    pixels.filter(is_unknown).filter_map(|p| Some((p, light(p)?))).collect()
}

/// Those of `unknown` pixels that are brighter than what surrounds them, where they are fewer than a spot lights: two users who stay beside each
/// other are odd in every frame too.
fn bright_beside(learner: &Learner, unknown: &[(usize, f64)]) -> Vec<usize> {
    let camera = learner.camera;
    let nx = camera.x.n;
    let is_bright = |p: usize, light: f64| {
        let beside = unknown.iter().filter(|(q, _)| is_within(nx, p, *q, 2));
        light
            > HALF
                * beside
                    .map(|(_, light)| *light)
                    .fold(OUTLIER * learner.noise_j, f64::max)
    };
    let bright = unknown
        .iter()
        .filter(|(p, light)| is_bright(*p, *light))
        .map(|(p, _)| *p);
    let patches = patches(nx, bright.collect()).into_iter();
    patches.filter(|patch| !is_of_spot(camera, patch)).flatten().collect()
}

/// Leaves patches of bad pixels as they were that are as large as a spot: what light was not explained there is some beam's.
fn spare_spots(camera: &Camera, found: &mut PixelMaps, own: &PixelMaps) {
    let nx = camera.x.n;
    let bad = found.bad.iter().enumerate().filter(|(_, bad)| **bad).map(|(p, _)| p);
    let patches = patches(nx, bad.collect()).into_iter();
    for p in patches.filter(|patch| is_of_spot(camera, patch)).flatten() {
        let at = (p / nx, p % nx);
        (found.bad[at], found.gain[at], found.dark_j[at]) = (own.bad[at], own.gain[at], own.dark_j[at]);
    }
}

fn is_within(nx: usize, p: usize, q: usize, reach: usize) -> bool {
    (q % nx).abs_diff(p % nx) <= reach && (q / nx).abs_diff(p / nx) <= reach
}

/// The pixels in patches of neighbours.
fn patches(nx: usize, mut pixels: Vec<usize>) -> Vec<Vec<usize>> {
    let mut found = Vec::new();
    while let Some(first) = pixels.pop() {
        let mut patch = vec![first];
        let mut next = 0;
        while next < patch.len() {
            let p = patch[next];
            patch.extend(pixels.extract_if(.., |q| is_within(nx, p, *q, 1)));
            next += 1;
        }
        found.push(patch);
    }
    found
}

/// Whether a patch has as many pixels as a spot lights.
fn is_of_spot(camera: &Camera, patch: &[usize]) -> bool {
    let pitch = |axis: &Axis| axis.edge(1) - axis.edge(0);
    let lit = HALF_LIGHT * camera.spot_sigma_m.powi(2) / (pitch(&camera.x) * pitch(&camera.y));
    patch.len() as f64 >= lit.max(LEAST_PATCH)
}

/// What each frame would be if all pixels were alike; pixels around odd spots are not used.
fn expected<'a>(learner: &'a Learner, odd: &[Odd]) -> Vec<Pixels<'a>> {
    let camera = learner.camera;
    let nx = camera.x.n;
    let mut frames: Vec<Pixels> = learner
        .images
        .iter()
        .map(|image| Pixels {
            ideal: vec![image.level; image.pixels.len()],
            recorded: &image.pixels,
            used: image.weight.iter().map(|w| *w > 0.0).collect(),
        })
        .collect();
    for patch in &learner.patches {
        let values = patch.expected(camera, &learner.model);
        let frame = &mut frames[patch.frame];
        for (row, line) in patch.y.clone().zip(values.chunks_exact(patch.x.len())) {
            let start = row * nx + patch.x.start;
            frame.ideal[start..start + line.len()].copy_from_slice(line);
        }
    }
    let reach = learner.model.radius_m();
    for odd in odd {
        let columns = pixels_within(&camera.x, odd.at[0], reach);
        for j in pixels_within(&camera.y, odd.at[1], reach) {
            frames[odd.frame].used[j * nx + columns.start..j * nx + columns.end].fill(false);
        }
    }
    leave_out_flashes(learner, &mut frames);
    frames
}

/// Samples this many σ and this share of the light away are outliers. Where a pixel has few of them, they are not its own doing.
const OUTLIER: f64 = 6.0;
const OUTLIER_SHARE: f64 = 0.1;
const FEW: f64 = 0.1;
/// Share of the light of the brightest neighbour from which on a pixel that nothing is known of is bad too.
const HALF: f64 = 0.5;
/// Area of a Gaussian spot brighter than half of its peak, σ²; and pixels side by side that may be bad however small spots are.
const HALF_LIGHT: f64 = 4.36;
const LEAST_PATCH: f64 = 3.0;

fn leave_out_flashes(learner: &Learner, frames: &mut [Pixels]) {
    for p in 0..frames.first().map_or(0, |f| f.used.len()) {
        let used = frames.iter().filter(|f| f.used[p]).count();
        let is_outlier = |k: usize, frame: &Pixels| {
            let light = frame.ideal[p] - learner.images[k].level;
            (frame.recorded[p] - frame.ideal[p]).abs() > OUTLIER * learner.noise_j + OUTLIER_SHARE * light.abs()
        };
        let indexed = frames.iter().enumerate().filter(|(_, f)| f.used[p]);
        let outliers: Vec<usize> = indexed.filter(|(k, f)| is_outlier(*k, f)).map(|(k, _)| k).collect();
        if outliers.len() as f64 <= (FEW * used as f64).max(1.0) {
            outliers.into_iter().for_each(|k| frames[k].used[p] = false);
        }
    }
}

/// χ² of patches whose pixels are corrected by maps, with their places, energies and backgrounds fitted again.
fn chi2(learner: &Learner, patches: &[Patch], maps: &PixelMaps) -> f64 {
    let one = |patch: &Patch| {
        let mut patch = patch.clone();
        let nx = patch.x.len();
        for (k, (value, weight)) in patch.data.iter_mut().zip(&mut patch.weight).enumerate() {
            let at = (patch.y.start + k / nx, patch.x.start + k % nx);
            *value = (*value - maps.dark_j[at]) / maps.gain[at];
            *weight *= if maps.bad[at] { 0.0 } else { maps.gain[at] };
        }
        patch.fit(learner.camera, &learner.model, 6);
        patch.chi2
    };
    let chi2: Vec<f64> = patches.par_iter().map(one).collect();
    chi2.iter().sum()
}

/// Maps of pixels from which a pattern of dark levels had been taken off, J.
pub fn with_pattern(camera: &Camera, maps: Option<PixelMaps>, pattern_j: Option<&[f64]>) -> Option<PixelMaps> {
    let Some(pattern) = pattern_j else {
        return maps;
    };
    let mut maps = maps.unwrap_or_else(|| PixelMaps::ideal(camera.shape()));
    maps.dark_j.iter_mut().zip(pattern).for_each(|(dark, own)| *dark += own);
    Some(maps)
}

/// Relative scatter of the gains; none where they are alike.
pub fn gain_scatter(maps: &PixelMaps) -> Option<f64> {
    let n = maps.gain.len() as f64;
    let scatter = (maps.gain.iter().map(|g| (g - 1.0).powi(2)).sum::<f64>() / n).sqrt();
    (scatter > 0.0).then_some(scatter)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_as_large_as_a_spot_is_spared_and_single_bad_pixels_are_not() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let own = PixelMaps::ideal(camera.shape());
        let mut found = own.clone();
        // A spot's light on five by five pixels, one pixel, and two side by side.
        let spot = || (20..25).flat_map(|y| (30..35).map(move |x| (y, x)));
        for at in spot() {
            (found.bad[at], found.gain[at]) = (true, 0.7);
        }
        for at in [(5, 5), (40, 8), (40, 9)] {
            found.bad[at] = true;
        }
        spare_spots(&camera, &mut found, &own);
        assert!(spot().all(|at| !found.bad[at] && found.gain[at] == 1.0));
        assert_eq!(found.bad.iter().filter(|bad| **bad).count(), 3);
    }
}
