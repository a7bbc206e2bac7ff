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
use crate::optics::{Axis, Camera, Smear};
use crate::stats::is_cut_off;

/// Light of emitters, in standard deviations of the noise, below which a pixel is dark.
const DARK: f64 = 0.01;
/// Reduced χ² beyond which a frame may hold emitters that were not found.
const EXPLAINED: f64 = 2.0;

/// An estimator that is given frames without a steady background and odd pixels, and none twice.
pub(crate) struct SensorWatch {
    inner: Box<dyn Estimator>,
    camera: Camera,
    background: SteadyBackground,
    odd: OddPixels,
    is_lit: Array2<bool>,
    /// The newest frame without the background, in standard deviations of the noise, NaN where it is not usable.
    values: Array2<f64>,
    /// The newest frame as it came, and what was found in it.
    newest: Array2<f64>,
    found: Option<Estimate>,
}

impl SensorWatch {
    /// `camera`'s spots are Gaussians.
    pub fn new(inner: Box<dyn Estimator>, camera: &Camera) -> Self {
        Self {
            inner,
            camera: camera.clone(),
            background: SteadyBackground::default(),
            odd: OddPixels::new(camera),
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
        self.background.follow(&mut self.values, &self.is_lit);
    }

    /// The frame without what is known; none where nothing is.
    fn cleaned(&self, frame: &Frame) -> Option<Frame> {
        let surface = self.background.known();
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

    /// Learns the background of the frame that was read, in which these emitters were found.
    fn learn_background(&mut self, frame: &Frame, found: &Estimate) {
        let is_explained = found.reduced_chi2 < EXPLAINED;
        if self.background.is_due() && is_explained && !is_cut_off(frame.pixels.iter().copied()) {
            self.mark_lit(found);
            self.background.learn(&self.values, &self.is_lit);
        }
    }

    /// Marks the odd pixels and those that these emitters light.
    fn mark_lit(&mut self, found: &Estimate) {
        let camera = &self.camera;
        let sigma = camera.spot_sigma_m * (1.0 + camera.spot_growth.max(0.0));
        self.is_lit.assign(self.odd.pixels());
        let density = camera.x.pitch_m * camera.y.pitch_m / (std::f64::consts::TAU * sigma * sigma);
        for emitter in &found.emitters {
            let peak = emitter.energy_j * density / camera.noise_std_j;
            let reach = sigma * (2.0 * (peak / DARK).max(1.0).ln()).sqrt();
            let within = |axis: &Axis, at: f64| {
                let pixel = |v: f64| ((v - axis.min_m) / axis.pitch_m).clamp(0.0, axis.n as f64) as usize;
                pixel(at - reach)..pixel(at + reach + axis.pitch_m)
            };
            let [x, y] = emitter.sensor_m;
            for row in within(&camera.y, y) {
                for column in within(&camera.x, x) {
                    let away2 = (camera.x.centre(column) - x).powi(2) + (camera.y.centre(row) - y).powi(2);
                    self.is_lit[(row, column)] |= away2 < reach * reach;
                }
            }
        }
    }
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
        let scale = 1.0 / self.camera.noise_std_j;
        let spots = found
            .emitters
            .iter()
            .map(|emitter| (emitter.sensor_m, emitter.energy_j * scale));
        self.odd.learn(&self.values, &self.camera, spots);
        self.learn_background(frame, &found);
        self.found = Some(found.clone());
        Ok(found)
    }
}
