//! What a sensor shows beside the emitters in all frames: too faint for one frame to show, it would be emitters to all of them together.

use ndarray::Array2;

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::estimate::preprocess::screening::is_usable;
use crate::estimate::sequence::odd_pixels::OddPixels;
use crate::estimate::sequence::steady_background::SteadyBackground;
use crate::frame::Frame;
use crate::geo::Sight;
use crate::optics::psf::pixel_fraction;
use crate::optics::{Axis, Camera, Smear, add_spot};
use crate::stats::is_cut_off;

/// Light of emitters, in standard deviations of the noise, below which a pixel is dark; through a measured lens, whose halos are everywhere, the light
/// that its calibration explains to a hundredth of it.
const DARK: f64 = 0.01;
const DARK_MEASURED: f64 = 1.0;
/// Beyond which a Gaussian spot has less than a billionth of its peak, σ.
const LIT: f64 = 6.5;
/// Reduced χ² beyond which a frame may hold emitters that were not found.
const EXPLAINED: f64 = 2.0;

/// An estimator that is given frames without a steady background and odd pixels, and none twice.
pub(crate) struct SensorWatch {
    inner: Box<dyn Estimator>,
    camera: Camera,
    /// None where each frame tells its own.
    background: Option<SteadyBackground>,
    odd: OddPixels,
    /// What the emitters of the newest frame explain of it, in standard deviations of the noise.
    explained: Array2<f64>,
    is_lit: Array2<bool>,
    /// The newest frame without the background, in standard deviations of the noise, NaN where it is not usable.
    values: Array2<f64>,
    /// The newest frame as it came, and what was found in it.
    newest: Array2<f64>,
    found: Option<Estimate>,
}

impl SensorWatch {
    pub fn new(inner: Box<dyn Estimator>, camera: &Camera) -> Self {
        Self {
            background: Some(SteadyBackground::default()),
            ..Self::of_pixels(inner, camera)
        }
    }

    /// Only of odd pixels and repeated frames.
    pub fn of_pixels(inner: Box<dyn Estimator>, camera: &Camera) -> Self {
        Self {
            inner,
            camera: camera.clone(),
            background: None,
            odd: OddPixels::new(camera),
            explained: Array2::zeros(camera.shape()),
            is_lit: Array2::default(camera.shape()),
            values: Array2::zeros(camera.shape()),
            newest: Array2::zeros(camera.shape()),
            found: None,
        }
    }

    /// Takes a frame's values without the background that is known.
    fn read(&mut self, frame: &Frame) {
        let scale = 1.0 / self.camera.noise_std_j;
        let ceiling = self.camera.saturation_limit_j();
        self.values.zip_mut_with(&frame.pixels, |v, pixel| {
            *v = if is_usable(*pixel, scale, ceiling) {
                pixel * scale
            } else {
                f64::NAN
            };
        });
        if let Some(masked) = &frame.masked {
            let pixels = self.values.iter_mut().zip(masked);
            pixels.filter(|(_, masked)| **masked).for_each(|(v, _)| *v = f64::NAN);
        }
        if let Some(background) = &mut self.background {
            let has_halos = self.camera.spot_shape.is_some();
            background.follow(&mut self.values, (!has_halos).then_some(&self.is_lit));
        }
    }

    /// The frame without what is known; none where nothing is.
    fn cleaned(&self, frame: &Frame) -> Option<Frame> {
        let surface = self.background.as_ref().and_then(SteadyBackground::known);
        if surface.is_none() && !self.odd.are_any() || surface.is_some() && self.odd.are_all(&self.is_lit) {
            return None;
        }
        let mut pixels = frame.pixels.clone();
        if let Some(surface) = surface {
            surface.subtract(&mut pixels, self.camera.noise_std_j);
        }
        Some(Frame {
            pixels,
            masked: self.odd.with(frame.masked.as_ref()),
            ..*frame
        })
    }

    /// Learns from the frame that was read, in which these emitters were found.
    fn learn(&mut self, frame: &Frame, found: &Estimate) {
        self.explain(found);
        let scale = 1.0 / self.camera.noise_std_j;
        let spots = found.emitters.iter().map(|e| (e.sensor_m, e.energy_j * scale));
        let axes = [&self.camera.x, &self.camera.y];
        self.odd.learn(&self.values, &self.explained, axes, spots);
        let Some(background) = &mut self.background else { return };
        let is_explained = found.reduced_chi2 < EXPLAINED;
        if background.is_due() && is_explained && !is_cut_off(frame.pixels.iter().copied()) {
            let dark = self.camera.spot_shape.as_ref().map_or(DARK, |_| DARK_MEASURED);
            self.is_lit.assign(self.odd.pixels());
            self.is_lit
                .zip_mut_with(&self.explained, |lit, light| *lit |= *light > dark);
            self.values -= &self.explained;
            background.learn(&self.values, &self.is_lit);
        }
    }

    fn explain(&mut self, found: &Estimate) {
        let camera = &self.camera;
        self.explained.fill(0.0);
        for emitter in &found.emitters {
            let (at, light) = (emitter.sensor_m, emitter.energy_j / camera.noise_std_j);
            if camera.spot_shape.is_some() {
                add_spot(camera, at, light, self.explained.as_slice_mut().expect("row by row"));
                continue;
            }
            let sigma = camera.spot_sigma_at(at);
            let [(first_x, x), (first_y, y)] =
                [(&camera.x, at[0]), (&camera.y, at[1])].map(|(axis, at)| lit(axis, at, sigma));
            for (row, share_y) in (first_y..).zip(&y) {
                for (column, share_x) in (first_x..).zip(&x) {
                    self.explained[(row, column)] += light * share_x * share_y;
                }
            }
        }
    }
}

/// The first pixel of an axis that a Gaussian spot at `at` lights, and its shares of this and the following ones.
fn lit(axis: &Axis, at: f64, sigma: f64) -> (usize, Vec<f64>) {
    let pixel = |v: f64| ((v - axis.min_m) / axis.pitch_m).clamp(0.0, axis.n as f64);
    let first = pixel(at - LIT * sigma) as usize;
    let share = |k: usize| pixel_fraction(axis.edge(k), axis.edge(k + 1), at, sigma);
    let end = pixel(at + LIT * sigma).ceil() as usize;
    (first, (first..end).map(share).collect())
}

impl Estimator for SensorWatch {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.inner.set_smear(smear);
    }

    fn set_sight(&mut self, sight: Option<&Sight>) {
        self.inner.set_sight(sight);
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        if frame.pixels.dim() != self.camera.shape() {
            return self.inner.estimate_until(frame, is_over);
        }
        if let Some(found) = self.found.as_ref().filter(|_| frame.pixels == self.newest) {
            return Ok(found.clone());
        }
        self.newest.assign(&frame.pixels);
        self.found = None;
        self.read(frame);
        let cleaned = self.cleaned(frame);
        let found = self.inner.estimate_until(cleaned.as_ref().unwrap_or(frame), is_over)?;
        self.learn(frame, &found);
        self.found = Some(found.clone());
        Ok(found)
    }
}
