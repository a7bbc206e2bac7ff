//! Learns the spot's shape over the field, the noise and the pixel maps from frames whose positions nobody knows.

mod band;
mod constraints;
mod coverage;
mod detection;
mod error;
mod flashes;
mod grouping;
mod learn;
mod patch;
mod pixel_maps;
mod prepare;
mod solve;
mod statistics;
mod template_model;
mod terms;

use std::sync::Arc;

use ndarray::Array2;

use crate::optics::{Calibration, Camera, PixelMaps, SpotShape};
pub use coverage::{CELLS, Coverage};
pub use error::Error;
use error::{MIN_FRAMES, MIN_SPOTS};
use grouping::Image;
use learn::{Learner, MOST_ROUNDS};
use template_model::TemplateModel;

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
    /// Noise of a pixel, J, and its growth with the light where it shows, J.
    pub noise_std_j: f64,
    pub gain_j: Option<f64>,
    pub bad_pixels: usize,
    /// Whether the pixel maps explain the held-out frames better than the camera's, or name bad pixels that those do not.
    pub are_pixels_better: bool,
    /// Pixels that were hot in a single frame, over all frames.
    pub flashes: usize,
    /// Relative scatter of the gains, none where no gain map helps.
    pub gain_scatter: Option<f64>,
    pub saturation_j: Option<f64>,
    pub saturated_frames: usize,
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
/// Fall of χ² that is more than chance.
const BETTER: f64 = 30.0;

/// Most frames that are learned from, evenly spaced: more teach little and take long.
const MOST_FRAMES: usize = 250;
/// One frame in this many is held out.
const HELD_OUT: usize = 5;
/// Misfit of most spots in training, and of all that are not odd on the held-out frames, beyond which spots have no common shape.
const UNLIKE: f64 = 0.25;
const UNEXPLAINED: f64 = 0.05;

/// Progress of the learning.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    pub stage: &'static str,
    pub round: usize,
    pub reduced_chi2: f64,
    pub spots: usize,
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
    check_pixels(&prepared, &chosen)?;
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
    let (train, _) = split(&prepared.images);
    let mut learner = Learner::new(camera, &train, prepared.noise_j);
    let detected = Coverage::of(&learner);
    check_spots(&learner, &prepared, chosen.len())?;
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
    run(&mut learner, MOST_ROUNDS, "the spot's shape");
    let coverage = Coverage::of(&learner);
    check_spots(&learner, &prepared, chosen.len())?;
    let needed = Coverage::needed(camera);
    // Places that were spread over the pixel and are not any more follow a template that is none.
    let unexplained = statistics::unexplained(&learner);
    let is_locked = coverage.phases < needed && detected.phases >= needed && unexplained > UNEXPLAINED;
    if learner.misfit > UNLIKE || is_locked {
        return Err(Error::NotAlike {
            share: 100.0 * learner.misfit.max(unexplained),
        });
    }
    if coverage.phases < needed {
        return Err(Error::Phases {
            covered: coverage.phases,
            needed,
        });
    }

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
    let (train, held) = split(&prepared.images);
    let mut learner = Learner::with_model(camera, &train, noise_j, &model, misfit);

    // Over the field, as far as the held-out frames say that it helps.
    let held_fit = |model: &TemplateModel, misfit: f64, images: &[&Image]| -> f64 {
        let held = Learner::with_model(camera, images, noise_j, model, misfit);
        held.patches.iter().map(|p| p.chi2).sum()
    };
    if coverage.is_field_covered() {
        let mut best = held_fit(&learner.model, learner.misfit, &held);
        for degree in FIELD_DEGREES {
            let mut model = learner.model.clone();
            model.vary(degree, learner.field_radius_m());
            let mut varied = Learner::with_model(camera, &train, noise_j, &model, learner.misfit);
            run(&mut varied, FIELD_ROUNDS, "its change over the field");
            let chi2 = held_fit(&varied.model, varied.misfit, &held);
            if best - chi2 < BETTER {
                break;
            }
            best = chi2;
            learner = varied;
        }
    }

    // Of a shape that changes over the field, the same one everywhere left some light in the noise.
    let factor = statistics::residual_scale(&learner);
    let (mut model, misfit) = (learner.model, learner.misfit);
    prepared.scale_noise(factor);
    let noise_j = prepared.noise_j;

    // Pixel maps, from all frames with the shape held fixed.
    let everything = every(&prepared.images);
    let mut all = Learner::with_model(camera, &everything, noise_j, &model, misfit);
    let odd = all.mask_odd();
    all.fit(6);
    let pixels = pixel_maps::estimate(&all, &odd, &prepared.hot, is_held, BETTER);
    let maps = pixels.maps;
    drop(all);
    let images = match &maps {
        Some(maps) => prepare::corrected(prepared.images, maps),
        None => prepared.images,
    };
    let (train, held) = split(&images);
    if maps.is_some() {
        let mut again = Learner::with_model(camera, &train, noise_j, &model, misfit);
        run(&mut again, AGAIN_ROUNDS, "the shape with corrected pixels");
        model = again.model;
    }

    // The held-out frames decide.
    let mut after = Learner::with_model(camera, &held, noise_j, &model, misfit);
    let odd_held = after.mask_odd().len();
    after.fit(6);
    let count = terms::needed(&after);
    let after = after.refitted(terms::truncated(camera, &model, count));
    let before = after.refitted(TemplateModel::of_camera(camera, &model));
    let fit = |learner: &Learner| Fit {
        chi2: learner.patches.iter().map(|p| p.chi2).sum(),
        degrees_of_freedom: learner.patches.iter().map(|p| p.degrees_of_freedom()).sum(),
    };
    let (before_fit, after_fit) = (fit(&before), fit(&after));
    let unexplained = statistics::unexplained(&after);
    if unexplained > UNEXPLAINED || odd_held > after.sources() {
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
    let images = every(&images);
    let mut last = Learner::with_model(camera, &images, noise_j, &model, misfit);
    run(&mut last, LAST_ROUNDS, "all frames");
    let information = statistics::information(&last);
    let template = terms::truncated(camera, &last.model, count).template();
    let shape = SpotShape::from_template(&template, ROUNDING).expect("a normalised template has light");
    let peak_snr = statistics::peak_snr(&last);
    let spots = last.sources();
    let spot_error = variance
        .spot_error
        .max(1.0 / information)
        .max(constraints::light_left_out(camera, &last.model) / LEFT)
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
        noise_std_j: variance.read_noise_j,
        gain_j: variance.gain_j,
        bad_pixels: maps
            .as_ref()
            .map_or(0, |m: &PixelMaps| m.bad.iter().filter(|b| **b).count()),
        are_pixels_better: pixels.are_better,
        flashes: prepared.flashes,
        gain_scatter,
        saturation_j: prepared.saturation_j,
        saturated_frames: prepared.saturated_frames,
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
/// Significance that light beyond the learned support keeps under the weights of a spot error, as in the estimator: well below an
/// emitter's threshold.
const LEFT: f64 = 2.0;
/// Degrees that are tried in turn while the held-out frames gain by them.
const FIELD_DEGREES: [usize; 3] = [2, 3, 4];
const FIELD_ROUNDS: usize = 4;
const AGAIN_ROUNDS: usize = 4;
const LAST_ROUNDS: usize = 3;
/// Tolerance of the separable terms of a template that has few already.
const ROUNDING: f64 = 1e-6;

fn check_pixels(prepared: &prepare::Prepared, frames: &[(usize, &Array2<f64>)]) -> Result<(), Error> {
    let is_finite = frames.iter().any(|(_, pixels)| pixels.iter().any(|v| v.is_finite()));
    if !is_finite {
        return Err(Error::NotFinite { frames: frames.len() });
    }
    if prepared.noise_j <= f64::MIN_POSITIVE {
        return Err(Error::NoNoise { frames: frames.len() });
    }
    Ok(())
}

fn check_spots(learner: &Learner, prepared: &prepare::Prepared, frames: usize) -> Result<(), Error> {
    let spots = learner.sources();
    if spots >= MIN_SPOTS {
        return Ok(());
    }
    if 2 * prepared.saturated_frames > frames {
        return Err(Error::Saturated {
            frames,
            saturated: prepared.saturated_frames,
        });
    }
    Err(match spots {
        0 => Error::NoSpots {
            frames,
            noise_j: prepared.noise_j,
        },
        _ => Error::TooFewSpots { frames, spots },
    })
}
