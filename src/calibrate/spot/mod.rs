//! Learns the spot's shape over the field, the noise and the pixel maps from frames whose positions nobody knows.

mod band;
mod candidates;
mod checks;
mod constraints;
mod coverage;
mod detection;
mod elsewhere;
mod error;
mod fixed_pattern;
mod flashes;
mod grouping;
mod learn;
mod parts;
mod patch;
mod pixel_maps;
mod prepare;
mod pupil;
mod solve;
mod statistics;
mod stray_light;
mod template_model;
mod terms;
mod wavefront;

use std::fmt::{self, Display, Formatter};
use std::sync::Arc;

use ndarray::Array2;

use crate::optics::spot::Beyond;
use crate::optics::{Calibration, Camera, PixelMaps, SpotShape};
use candidates::BETTER;
pub use coverage::{CELLS, Coverage};
pub use error::Error;
use error::MIN_FRAMES;
use grouping::Image;
use learn::Learner;
pub use pupil::Wavefront;
use template_model::TemplateModel;
use terms::Separable;

/// χ² of the held-out frames' pixels around spots with one model.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Fit {
    pub chi2: f64,
    pub degrees_of_freedom: usize,
}

impl Fit {
    pub fn reduced(&self) -> f64 {
        self.chi2 / self.degrees_of_freedom.max(1) as f64
    }
}

/// What was learned.
#[derive(Clone, Debug)]
pub struct Learned {
    /// To be written: the camera's own figures where nothing better was found.
    pub calibration: Calibration,
    /// The learned shape, better or not.
    pub shape: SpotShape,
    /// Whether the shape explains the held-out frames better than the camera's spot does.
    pub is_shape_better: bool,
    pub frames: usize,
    pub spots: usize,
    /// Spots that were left out: two in one, or none.
    pub odd: usize,
    /// Peak signal-to-noise ratio of the spots: median and largest.
    pub peak_snr: [f64; 2],
    pub coverage: Coverage,
    /// Degree of the polynomials by which the shape changes over the field; 0: it does not, as far as these frames show.
    pub field_degree: usize,
    /// That of the lens, where the shape is learned from it.
    pub wavefront: Option<Wavefront>,
    /// Noise of a pixel, J, and its growth with the light where it shows, J.
    pub noise_std_j: f64,
    pub quantum_j: Option<f64>,
    pub bad_pixels: usize,
    /// Whether the pixel maps explain the held-out frames better than the camera's, or name bad pixels that those do not.
    pub are_pixels_better: bool,
    /// Pixels that were hot in a single frame, over all frames.
    pub flashes: usize,
    /// Relative scatter of the gains, none where no gain map helps.
    pub gain_scatter: Option<f64>,
    pub saturation_j: Option<f64>,
    pub saturated_frames: usize,
    /// Frames that are cut off at their darkest value: their noise is more than what they show.
    pub cut_off_frames: usize,
    pub before: Fit,
    pub after: Fit,
    /// Mean residual around the held-out spots over their energy, before and after, 1 at the learned peak; shape (2n+1, 2n+1) pixels.
    pub residuals: [Array2<f64>; 2],
}

impl Learned {
    /// Whether anything is better than what the camera says now.
    pub fn is_better(&self, camera: &Camera) -> bool {
        let noise = (self.noise_std_j / camera.noise_std_j).ln().abs() > NOISE_CHANGE;
        self.is_shape_better || noise || self.are_pixels_better
    }
}

/// Change of the noise that is worth a calibration: 3 % is within what sixty frames of overlapping spots measure.
const NOISE_CHANGE: f64 = 0.03;

/// Most frames that are learned from, evenly spaced: more teach little and take long.
const MOST_FRAMES: usize = 250;
/// One frame in this many is held out.
const HELD_OUT: usize = 5;

/// Progress of the learning.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    pub stage: &'static str,
    pub round: usize,
    pub reduced_chi2: f64,
    pub spots: usize,
}

impl Display for Progress {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self {
            stage, round, spots, ..
        } = self;
        let chi2 = self.reduced_chi2;
        write!(f, "{stage}: round {round}, {spots} spots, reduced χ² {chi2:.3}")
    }
}

/// Learns from frames of shape (Ny, Nx), J, each with its number in the recording; starts from the camera's Gaussian.
pub fn learn(
    camera: &Camera,
    frames: &[(usize, &Array2<f64>)],
    progress: &mut dyn FnMut(Progress),
) -> Result<Learned, Error> {
    if frames.len() < MIN_FRAMES {
        return Err(Error::TooFewFrames { frames: frames.len() });
    }
    let step = frames.len().div_ceil(MOST_FRAMES);
    let chosen: Vec<(usize, &Array2<f64>)> = frames.iter().step_by(step).copied().collect();
    let mut prepared = prepare::prepare(camera, &chosen);
    checks::pixels(&prepared, &chosen)?;
    // Each pass shows what the flashes that it masks have hidden.
    for _ in 0..FLASH_PASSES {
        let images = every(&prepared.images);
        let mut first = Learner::new(camera, &images, prepared.noise_j);
        first.fit(15);
        let flashes = first.mask_flashes();
        if flashes.is_empty() {
            break;
        }
        prepared.mask_flashes(&flashes);
    }
    let mut run = |learner: &mut Learner, rounds: usize, stage: &'static str| {
        learner.run(rounds, &mut |r| {
            progress(Progress {
                stage,
                round: r.round,
                reduced_chi2: r.reduced_chi2,
                spots: r.sources,
            });
        });
    };
    let (train, _) = split(&prepared.images);
    let detected = Learner::new(camera, &train, prepared.noise_j);
    checks::spots(&detected, &prepared, chosen.len())?;
    let detected_at = Coverage::of(&detected);
    let learner = candidates::first(detected, &mut run, &|learner| {
        checks::spots(learner, &prepared, chosen.len())?;
        checks::shape(learner, &detected_at)
    })?;
    let coverage = Coverage::of(&learner);

    // The first estimate of the noise counts some of the spots' light; what the shape leaves does not.
    let (model, misfit, factor) = (
        learner.model.clone(),
        learner.misfit,
        statistics::residual_scale(&learner),
    );
    drop(learner);
    prepared.scale_noise(factor);
    let noise_j = prepared.noise_j;
    let flashes = Learner::with_model(camera, &every(&prepared.images), noise_j, &model, misfit).mask_flashes();
    prepared.mask_flashes(&flashes);
    let (mut model, passes) = (
        model,
        if prepared.pattern_j.is_some() {
            PATTERN_PASSES
        } else {
            0
        },
    );
    for _ in 0..passes {
        // What is left of a pattern would be taken for a shape that changes over the field.
        let Some(maps) = pixel_maps::of_frames(camera, &mut prepared, &model, misfit, is_held, BETTER).maps else {
            break;
        };
        prepared.take_off(&maps.dark_j);
        let (train, _) = split(&prepared.images);
        let mut again = Learner::with_model(camera, &train, prepared.noise_j, &model, misfit);
        run(&mut again, AGAIN_ROUNDS, "the shape without the pattern of dark levels");
        let factor = statistics::residual_scale(&again);
        model = again.model;
        prepared.scale_noise(factor);
    }
    let noise_j = prepared.noise_j;
    let (train, held) = split(&prepared.images);
    let learner = Learner::with_model(camera, &train, noise_j, &model, misfit);
    let learner = candidates::best(learner, &held, coverage.is_field_covered(), &mut run);

    // Of a shape that changes over the field, the same one everywhere left some light in the noise.
    let factor = statistics::residual_scale(&learner);
    let (mut model, misfit) = (learner.model, learner.misfit);
    prepared.scale_noise(factor);
    let noise_j = prepared.noise_j;

    let pixels = pixel_maps::of_frames(camera, &mut prepared, &model, misfit, is_held, BETTER);
    if let Some(maps) = &pixels.maps {
        prepared.correct(maps);
        let (train, _) = split(&prepared.images);
        let mut again = Learner::with_model(camera, &train, noise_j, &model, misfit);
        run(&mut again, AGAIN_ROUNDS, "the shape with corrected pixels");
        model = again.model;
    }
    let maps = pixel_maps::with_pattern(camera, pixels.maps, prepared.pattern_j.as_deref());
    let (_, held) = split(&prepared.images);

    // The held-out frames decide.
    let mut after = Learner::with_model(camera, &held, noise_j, &model, misfit);
    let odd_held = after.mask_odd().len();
    after.fit(6);
    let known = after.as_far_as_seen();
    let after = after.refitted(known.clone());
    let count = Separable::needed(&after).unwrap_or(1);
    let dark = || Error::NotAlike { share: 100.0 };
    let separable = Separable::of(camera, &known, count).ok_or_else(dark)?;
    let after = after.refitted(separable.template(&known));
    let before = after.refitted(TemplateModel::of_camera(camera, &known));
    let fit = |learner: &Learner| Fit {
        chi2: learner.patches.iter().map(|p| p.chi2).sum(),
        degrees_of_freedom: learner.patches.iter().map(|p| p.degrees_of_freedom()).sum(),
    };
    let (before_fit, after_fit) = (fit(&before), fit(&after));
    let shot = statistics::variance(&after).quantum_j;
    let unexplained = statistics::unexplained(&after, 1.0, shot.unwrap_or(0.0));
    if unexplained > checks::UNEXPLAINED || odd_held > after.sources() {
        return Err(Error::NotAlike {
            share: 100.0 * unexplained,
        });
    }
    let is_shape_better = before_fit.chi2 - after_fit.chi2 > BETTER;
    let judged = if is_shape_better { &after } else { &before };
    let variance = statistics::variance(judged);
    let residuals = [&before, &after].map(|l| statistics::mean_residual(l, constraints::norm(camera, &model)));
    drop((after, before));

    // What is written is learned from all frames.
    let images = every(&prepared.images);
    let mut last = Learner::with_model(camera, &images, noise_j, &model, misfit);
    run(&mut last, LAST_ROUNDS, "all frames");
    let information = statistics::information(&last);
    let model = last.as_far_as_seen();
    let separable = Separable::of(camera, &model, count).ok_or_else(dark)?;
    let shape = separable.shape(&model).ok_or_else(dark)?;
    if is_shape_better {
        checks::compact(&shape, [prepared.saturated_frames, frames.len()])?;
    }
    let peak_snr = statistics::peak_snr(&last);
    let spots = last.sources();
    let left_out = (constraints::light_left_out(camera, &model) / LEFT).min(Camera::LARGEST_SPOT_ERROR);
    let shape = shape.with_beyond(Some(Beyond {
        error: left_out,
        from_m: constraints::known_radius_m(&model),
    }));
    let spot_error = variance
        .spot_error
        .max(elsewhere::spot_error(&last, &variance))
        .max(1.0 / information)
        .max(if is_shape_better { 0.0 } else { left_out })
        .min(Camera::LARGEST_SPOT_ERROR);
    let gain_scatter = maps.as_ref().and_then(pixel_maps::gain_scatter);
    let calibration = Calibration {
        spot_sigma_m: if is_shape_better {
            shape.sigma_equivalent_m()
        } else {
            camera.spot_sigma_m
        },
        spot_growth: if is_shape_better { 0.0 } else { camera.spot_growth },
        spot_shape: match is_shape_better {
            true => Some(Arc::new(shape.clone())),
            false => camera.spot_shape.clone(),
        },
        spot_error: Some(spot_error),
        noise_std_j: variance.read_noise_j,
        quantum_j: variance.quantum_j,
        pixels: maps.clone().map(Arc::new),
        ..Calibration::of(camera)
    };
    Ok(Learned {
        calibration,
        is_shape_better,
        frames: chosen.len(),
        spots,
        odd: odd_held,
        peak_snr,
        coverage,
        field_degree: last.model.degree,
        wavefront: last.model.pupil.map(|pupil| pupil.wavefront()),
        noise_std_j: variance.read_noise_j,
        quantum_j: variance.quantum_j,
        bad_pixels: maps
            .as_ref()
            .map_or(0, |m: &PixelMaps| m.bad.iter().filter(|b| **b).count()),
        are_pixels_better: pixels.are_better || prepared.pattern_j.is_some(),
        flashes: prepared.flashes,
        gain_scatter,
        saturation_j: prepared.saturation_j,
        saturated_frames: prepared.saturated_frames,
        cut_off_frames: prepared.cut_off_frames,
        before: before_fit,
        after: after_fit,
        residuals,
        shape,
    })
}

fn every(images: &[Image]) -> Vec<&Image> {
    images.iter().collect()
}

/// Images to learn from, and those held out.
fn split(images: &[Image]) -> (Vec<&Image>, Vec<&Image>) {
    let part = |held: bool| {
        let images = images.iter().enumerate().filter(|(k, _)| is_held(*k) == held);
        images.map(|(_, image)| image).collect()
    };
    (part(false), part(true))
}

fn is_held(k: usize) -> bool {
    k % HELD_OUT == HELD_OUT / 2
}

const FLASH_PASSES: usize = 3;
/// Passes of dark levels and shape in turns: each is as exact as the other lets it be.
const PATTERN_PASSES: usize = 3;
/// Significance that light beyond the learned support keeps under the weights of a spot error, as in the estimator: well below an
/// emitter's threshold.
const LEFT: f64 = 2.0;
const AGAIN_ROUNDS: usize = 4;
const LAST_ROUNDS: usize = 3;
