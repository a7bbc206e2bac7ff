//! The detector: converts light on the array to the energies read out.

use ndarray::Array2;

use super::config::Scene;
use super::effect::Effect;
use super::effects::{Converter, DefectMap, Glint};
use super::effects::{Saturation, ShotNoise, ThermalNoise};
use super::light::{Light, brightest_pixel};
use super::moment::Moment;
use super::render::{Renderer, Spot};
use super::report::{Decisions, Status};
use super::stream::{Ledger, Streams};
use crate::optics::{Camera, PixelMaps};
use crate::toml_file::{Key, OutOfRange};

/// The array and its read-out.
#[derive(Debug)]
pub(super) struct Detector {
    /// Glints that vary with time.
    glints: Vec<(Glint, Spot)>,
    gain: Option<Vec<f64>>,
    /// Background, steady glints and dark current in one image: every pixel's energy without a beam, J.
    offset: Option<Vec<f64>>,
    dark: Option<Vec<f64>>,
    quantum_j: Option<f64>,
    /// Level, and the table where it blooms.
    saturation: Option<(f64, Option<Saturation>)>,
    thermal_std_j: Option<f64>,
    defects: Option<DefectMap>,
    converter: Option<Converter>,
}

impl Detector {
    pub fn new(scene: &Scene, light: &Light, streams: Streams, decisions: &mut Decisions) -> Result<Self, OutOfRange> {
        let ledger = Ledger::default();
        let once = |effect| streams.open(effect, 0, 0, &ledger);
        let field = Key::new("effects");
        let effects = &scene.effects;
        let camera = &light.lens;
        let (ny, nx) = camera.shape();
        let peak = brightest_pixel(scene, camera);

        let background = decisions.weigh(Effect::Background, &effects.background, |b| b.brightest());
        if background.is_some() {
            decisions.note(
                Effect::Background,
                Status::Folded,
                "part of one image, made once and added to every frame",
            );
        }
        let glints = decisions.weigh(Effect::Glint, &effects.glint, |all| all.iter().map(|g| g.peak_j).sum());
        let glints = glints.into_iter().flatten().map(|g| (g.clone(), g.spot(camera)));
        let (steady, passing): (Vec<_>, Vec<_>) = glints.partition(|(g, _)| g.present == Default::default());
        if !passing.is_empty() {
            decisions.note(
                Effect::Glint,
                Status::On,
                format!("{} that come and go; steady ones are folded", passing.len()),
            );
        } else if !steady.is_empty() {
            decisions.note(Effect::Glint, Status::Folded, "steady: part of one image, made once");
        }
        let lit = peak + background.map_or(0.0, |b| b.brightest());
        let gain = decisions.weigh(Effect::Gain, &effects.gain, |g| 3.0 * g.std * lit);
        if gain.is_some() {
            decisions.note(Effect::Gain, Status::On, "a pattern drawn once; one product a pixel");
        }
        let gain = gain.map(|g| g.map(ny * nx, &mut *once(Effect::Gain)));
        let dark = decisions.weigh(Effect::DarkCurrent, &effects.dark_current, |d| {
            d.energy_j * (1.0 + 3.0 * d.spread)
        });
        if dark.is_some() {
            decisions.note(
                Effect::DarkCurrent,
                Status::Folded,
                "part of one image, made once and added to every frame",
            );
        }
        let dark = dark.map(|d| d.map(ny * nx, &mut *once(Effect::DarkCurrent)));

        let shot_field = field.at("shot_noise");
        let quantum = |s: &ShotNoise| s.quantum(&shot_field);
        let brightest = lit + effects.dark_current.as_ref().map_or(0.0, |d| d.energy_j);
        let shot = decisions.weigh(Effect::ShotNoise, &effects.shot_noise, |s| {
            quantum(s).map_or(f64::INFINITY, |q| (q * brightest).sqrt())
        });
        if shot.is_some() {
            decisions.note(
                Effect::ShotNoise,
                Status::On,
                "one draw a pixel that has light or dark current",
            );
        }

        let saturation = Self::saturation(scene, decisions, &field)?;
        let thermal = effects.thermal_noise.as_ref();
        match thermal {
            Some(_) => decisions.note(Effect::ThermalNoise, Status::On, "one draw a pixel"),
            None => decisions.note(Effect::ThermalNoise, Status::Off, "not in the scene"),
        }
        let defects = decisions.weigh(Effect::Defects, &effects.defects, |_| f64::INFINITY);
        if defects.is_some() {
            decisions.note(
                Effect::Defects,
                Status::On,
                "a map drawn once; only the broken pixels are touched",
            );
        }
        let data_sheet = scene.optics.joules_per_count;
        let quantisation = field.at("quantisation");
        let converter = match &effects.quantisation {
            Some(table) => Some(table.converter(data_sheet, &quantisation)?),
            None => None,
        };
        let converter = decisions
            .weigh(Effect::Quantisation, &converter, |c| c.step_j / 12f64.sqrt())
            .copied();
        if converter.is_some() {
            decisions.note(Effect::Quantisation, Status::On, "one rounding a pixel");
        }

        let mut detector = Self {
            glints: passing,
            gain,
            offset: None,
            dark,
            quantum_j: shot.map(quantum).transpose()?,
            saturation,
            thermal_std_j: thermal.map(|t| t.std_j.unwrap_or(camera.noise_std_j)),
            defects: defects.map(|d| d.map((ny, nx), &mut *once(Effect::Defects))),
            converter,
        };
        if background.is_some() || !steady.is_empty() || detector.dark.is_some() {
            let mut image = vec![0.0; ny * nx];
            for (index, pixel) in image.iter_mut().enumerate() {
                let (row, column) = (index / nx, index % nx);
                let at = [camera.x.centre(column), camera.y.centre(row)];
                *pixel = background.map_or(0.0, |b| b.at(camera, row, column) * light.passed(at));
            }
            let mut renderer = Renderer::default();
            for (_, spot) in &steady {
                renderer.add(camera, spot, &mut image);
            }
            detector.amplify(&mut image);
            for (pixel, dark) in image.iter_mut().zip(detector.dark.iter().flatten()) {
                *pixel += dark;
            }
            detector.offset = Some(image);
        }
        Ok(detector)
    }

    fn saturation(
        scene: &Scene,
        decisions: &mut Decisions,
        field: &Key,
    ) -> Result<Option<(f64, Option<Saturation>)>, OutOfRange> {
        let table = scene.effects.saturation.as_ref();
        let level = table.and_then(|s| s.level_j).or(scene.optics.saturation_j);
        match (table, level) {
            (None, None) => decisions.note(Effect::Saturation, Status::Off, "not in the scene"),
            (None, Some(_)) => decisions.note(
                Effect::Saturation,
                Status::On,
                "optics.saturation_j is set: every pixel is clipped",
            ),
            (Some(_), Some(_)) => decisions.note(
                Effect::Saturation,
                Status::On,
                "full pixels spill over; every pixel is clipped",
            ),
            (Some(_), None) => {
                let field = field.at("saturation").at("level_j");
                return Err(field.refuse("a value here or in optics.saturation_j", "neither"));
            }
        }
        Ok(level.map(|level| (level, table.filter(|t| t.blooming > 0.0).cloned())))
    }

    /// Turns the light on the array, J, into what is read out, in place.
    pub fn read(&self, camera: &Camera, at: Moment<'_>, renderer: &mut Renderer, pixels: &mut [f64]) {
        let open = |effect| at.streams.open(effect, 0, at.k, at.ledger);
        for (_, spot) in self.glints.iter().filter(|(g, _)| g.present.on(at.t)) {
            renderer.add(camera, spot, pixels);
        }
        self.amplify(pixels);
        if let Some(offset) = &self.offset {
            for (pixel, offset) in pixels.iter_mut().zip(offset) {
                *pixel += offset;
            }
        }
        if let Some(quantum_j) = self.quantum_j {
            ShotNoise::apply(quantum_j, pixels, &mut *open(Effect::ShotNoise));
        }
        if let Some((level, Some(table))) = &self.saturation {
            table.bloom(*level, camera.x.n, pixels);
        }
        if let Some(std_j) = self.thermal_std_j {
            ThermalNoise::add(std_j, pixels, &mut *open(Effect::ThermalNoise));
        }
        if let Some(defects) = &self.defects {
            defects.apply(pixels);
        }
        if let Some((level, _)) = &self.saturation {
            Saturation::clip(*level, pixels);
        }
        if let Some(converter) = &self.converter {
            converter.apply(pixels);
        }
    }

    /// Pixels that frames come with masked.
    pub fn mask(&self) -> Option<&Array2<bool>> {
        self.defects.as_ref().and_then(|d| d.mask.as_ref())
    }

    /// σ_n, where there is thermal noise.
    pub fn noise_std_j(&self) -> Option<f64> {
        self.thermal_std_j
    }

    /// The corrections that a perfect calibration would find, where the array needs any. Shape (Ny, Nx).
    pub fn maps(&self, shape: (usize, usize)) -> Option<PixelMaps> {
        if self.gain.is_none() && self.dark.is_none() && self.defects.is_none() {
            return None;
        }
        let mut maps = PixelMaps::ideal(shape);
        for (to, from) in maps.gain.iter_mut().zip(self.gain.iter().flatten()) {
            *to = *from;
        }
        for (to, from) in maps.dark_j.iter_mut().zip(self.dark.iter().flatten()) {
            *to = *from;
        }
        if let Some(defects) = &self.defects {
            let bad = maps.bad.as_slice_mut().expect("a fresh array is contiguous");
            defects.broken().for_each(|index| bad[index] = true);
        }
        Some(maps)
    }

    fn amplify(&self, pixels: &mut [f64]) {
        if let Some(gain) = &self.gain {
            for (pixel, gain) in pixels.iter_mut().zip(gain) {
                *pixel *= gain;
            }
        }
    }
}
