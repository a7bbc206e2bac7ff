//! The alternation of places and template (effective PSF: Anderson and King, 2000), with the template solved for as splines.

use rayon::prelude::*;

use super::constraints::{self, norm};
use super::detection::{self, MatchedFilter, Peak};
use super::flashes;
use super::grouping::{self, Image};
use super::patch::{Patch, Source};
use super::pupil::Pupil;
use super::solve;
use super::template_model::TemplateModel;
use super::wavefront;
use crate::optics::Camera;
use crate::stats::median;

/// Knots a width: the largest distance of knots in σ. Cubic splines err by the fourth power of it.
const KNOTS_PER_SIGMA: f64 = 3.2;
/// Largest distance of knots in pixels; finer ones than [`FINEST`] are not determined by pixels.
const COARSEST: f64 = 0.5;
const FINEST: f64 = 0.25;
/// Half the support at the start, σ, and the factor by which it grows while there is light at its edge.
pub const FIRST_RADIUS: f64 = 6.0;
const GROWTH: f64 = 1.5;
/// Half the support of a pupil's spot at the start, σ: an aberrated one is wide.
const FIRST_PUPIL_RADIUS: f64 = 9.0;
/// Most splines a side: what a matrix of them costs in each round.
const MOST_SPLINES: usize = 97;
/// Largest half of the support, half sensors: spots near an edge show their tails as far as the other edge.
const WIDEST: f64 = 1.8;
/// Light at the edge that matters: of the brightest spot, in standard deviations of one pixel. The tails of five spots at this height add
/// up to a quarter of an emitter's threshold, by estimate; more leaves them to the spot error, less takes longer. Not measured.
const EDGE_LIGHT: f64 = 0.1;
/// Relative fall of χ² per degree of freedom below which there are no more rounds.
const SETTLED: f64 = 1e-3;
/// Least matched signal-to-noise ratio of a source that a patch is used for.
const LEAST_SNR: f64 = 12.0;

/// State of the learning.
pub struct Learner<'a> {
    pub camera: &'a Camera,
    pub images: &'a [&'a Image],
    pub noise_j: f64,
    pub model: TemplateModel,
    pub patches: Vec<Patch>,
    /// Share of a spot's norm that the template does not explain, median over the spots.
    pub misfit: f64,
    filter: MatchedFilter,
}

/// A spot that was left out because the template does not explain it.
#[derive(Clone, Copy, Debug)]
pub struct Odd {
    pub frame: usize,
    pub at: [f64; 2],
}

/// What a round reports.
#[derive(Clone, Copy, Debug)]
pub struct Round {
    pub round: usize,
    pub reduced_chi2: f64,
    pub sources: usize,
}

impl<'a> Learner<'a> {
    /// Finds spots with the camera's Gaussian.
    pub fn new(camera: &'a Camera, images: &'a [&'a Image], noise_j: f64) -> Self {
        let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
        let knot_m = (camera.spot_sigma_m / KNOTS_PER_SIGMA).clamp(FINEST * pitch, f64::MAX);
        let knot_m = match camera.spot_sigma_m > 4.0 * COARSEST * KNOTS_PER_SIGMA * pitch {
            true => knot_m,
            false => knot_m.min(COARSEST * pitch),
        };
        let radius = FIRST_RADIUS * camera.spot_sigma_m.max(pitch);
        let model = TemplateModel::gaussian(camera, knot_m, radius);
        let mut learner = Self {
            camera,
            images,
            noise_j,
            model,
            patches: Vec::new(),
            misfit: 0.0,
            filter: MatchedFilter::new(camera),
        };
        learner.detect();
        learner
    }

    /// The same images with a model that was learned elsewhere.
    pub fn with_model(
        camera: &'a Camera,
        images: &'a [&'a Image],
        noise_j: f64,
        model: &TemplateModel,
        misfit: f64,
    ) -> Self {
        let mut learner = Self::new(camera, images, noise_j);
        learner.adopt(model.clone());
        learner.misfit = misfit;
        learner.fit(12);
        learner.find_missing();
        learner.fit(12);
        learner
    }

    /// Half-width of the window in which a spot has light.
    fn radius_m(&self) -> f64 {
        self.model.radius_m()
    }

    /// First sources: peaks that no spot's halo explains, whatever its shape.
    fn detect(&mut self) {
        let (camera, noise, radius) = (self.camera, self.noise_j, self.radius_m());
        let halo = |d: f64| detection::unknown_halo(d / camera.spot_sigma_m);
        self.patches = self
            .images
            .par_iter()
            .enumerate()
            .flat_map_iter(|(k, image)| {
                let above: Vec<f64> = image
                    .pixels
                    .iter()
                    .zip(&image.weight)
                    .map(|(v, w)| if *w > 0.0 { v - image.level } else { 0.0 })
                    .collect();
                let peaks = self.filter.peaks(camera, &above, noise);
                let own = detection::own_spots(&peaks, &[], halo);
                grouping::patches(camera, k, image, own.iter().map(Source::from).collect(), radius)
            })
            .collect();
    }

    /// Cuts the frames anew for a model of another support.
    pub fn adopt(&mut self, model: TemplateModel) {
        self.model = model;
        let mut sources: Vec<Vec<Source>> = vec![Vec::new(); self.images.len()];
        for patch in self.patches.drain(..) {
            sources[patch.frame].extend(patch.sources);
        }
        self.cut(sources);
    }

    fn cut(&mut self, sources: Vec<Vec<Source>>) {
        let (camera, images, radius) = (self.camera, self.images, self.radius_m());
        self.patches = sources
            .into_par_iter()
            .enumerate()
            .flat_map_iter(|(k, sources)| grouping::patches(camera, k, images[k], sources, radius))
            .collect();
    }

    /// Fits places, energies and backgrounds with the template held fixed, and drops what is too faint or has left the sensor.
    pub fn fit(&mut self, steps: usize) {
        let (camera, model) = (self.camera, &self.model);
        self.patches
            .par_iter_mut()
            .for_each(|patch| patch.fit(camera, model, steps));
        let least = LEAST_SNR * self.noise_j / norm(camera, model);
        let inside = |s: &Source| {
            let near = |k: usize| s.at[k].abs() < [camera.x.half_width(), camera.y.half_width()][k];
            near(0) && near(1)
        };
        for patch in &mut self.patches {
            patch.sources.retain(|s| s.energy_j > least && inside(s));
        }
        self.patches.retain(|patch| !patch.sources.is_empty());
        self.misfit = self.median_misfit();
    }

    pub fn reduced_chi2(&self) -> f64 {
        let sums = self.patches.iter().fold((0.0, 0.0), |(chi2, dof), p| {
            (chi2 + p.chi2, dof + p.degrees_of_freedom() as f64)
        });
        sums.0 / f64::max(sums.1, 1.0)
    }

    /// χ² of all pixels of the images, those of patches and those between them.
    pub fn chi2_of_images(&self) -> f64 {
        let of = |(image, patches): (&Image, Vec<&Patch>)| {
            let residual = grouping::residual(self.camera, &self.model, image, &patches);
            let weighted = residual.iter().zip(&image.weight);
            weighted.map(|(r, w)| (r * w).powi(2)).sum::<f64>()
        };
        let chi2: Vec<f64> = self.by_image().into_par_iter().map(of).collect();
        chi2.iter().sum()
    }

    fn by_image(&self) -> Vec<(&'a Image, Vec<&Patch>)> {
        let mut by_image: Vec<_> = self.images.iter().map(|image| (*image, Vec::new())).collect();
        self.patches
            .iter()
            .for_each(|patch| by_image[patch.frame].1.push(patch));
        by_image
    }

    pub fn sources(&self) -> usize {
        self.patches.iter().map(|p| p.sources.len()).sum()
    }

    /// Misfit of each source, patch by patch.
    pub fn misfits(&self) -> Vec<Vec<f64>> {
        let (camera, model) = (self.camera, &self.model);
        let of = |patch: &Patch| patch.misfits(camera, model);
        self.patches.par_iter().map(of).collect()
    }

    fn median_misfit(&self) -> f64 {
        median(self.misfits().concat()).unwrap_or(0.0)
    }

    /// Adds spots that the residual shows; what a brighter spot's own misfit may look like is left alone.
    pub fn find_missing(&mut self) -> usize {
        let (camera, noise) = (self.camera, self.noise_j);
        let share = (4.0 * self.misfit).clamp(0.01, 0.25);
        let near = 3.0 * camera.spot_sigma_m;
        let found: Vec<(Vec<Source>, usize)> = self
            .by_image()
            .into_par_iter()
            .map(|(image, patches)| {
                let mut residual = grouping::residual(self.camera, &self.model, image, &patches);
                for (r, weight) in residual.iter_mut().zip(&image.weight) {
                    if *weight == 0.0 {
                        *r = 0.0;
                    }
                }
                let known: Vec<Source> = patches.iter().flat_map(|p| p.sources.iter().cloned()).collect();
                let brighter: Vec<Peak> = known.iter().map(Peak::from).collect();
                let peaks = self.filter.peaks(camera, &residual, noise);
                // A spot's core is where its misfit is.
                let halo = |d: f64| match d {
                    d if d < near => share,
                    d if d < self.radius_m() => share.min(0.05),
                    _ => 0.005,
                };
                let own = detection::own_spots(&peaks, &brighter, halo);
                let count = own.len();
                (known.into_iter().chain(own.iter().map(Source::from)).collect(), count)
            })
            .collect();
        let added = found.iter().map(|f| f.1).sum();
        if added > 0 {
            self.cut(found.into_iter().map(|f| f.0).collect());
        }
        added
    }

    /// Takes single bright pixels in spots out of use; returns (index of the image, index of the pixel in it).
    pub fn mask_flashes(&mut self) -> Vec<(usize, usize)> {
        let (camera, model, noise_j) = (self.camera, &self.model, self.noise_j);
        let mask = |patch: &mut Patch| -> Vec<(usize, usize)> {
            let found = flashes::in_spots(camera, model, noise_j, patch);
            for (j, i) in &found {
                patch.weight[(j - patch.y.start) * patch.x.len() + i - patch.x.start] = 0.0;
            }
            if !found.is_empty() {
                patch.fit(camera, model, 6);
            }
            let index = |(j, i)| (patch.frame, j * camera.x.n + i);
            found.into_iter().map(index).collect()
        };
        self.patches.par_iter_mut().flat_map_iter(mask).collect()
    }

    /// Takes pixels out of use around spots that the template does not explain although it explains most: two in one, a saturated
    /// one, something that is no spot. Returns them.
    pub fn mask_odd(&mut self) -> Vec<Odd> {
        let limit = (4.0 * self.misfit).max(0.02);
        let camera = self.camera;
        let reach = 4.0 * camera.spot_sigma_m;
        let noise_share = |e: f64, norm: f64| 4.0 * self.noise_j / (e * norm);
        let norm = norm(camera, &self.model);
        let misfits = self.misfits();
        let mut found = Vec::new();
        for (patch, misfits) in self.patches.iter_mut().zip(misfits) {
            let is_odd: Vec<bool> = patch
                .sources
                .iter()
                .zip(&misfits)
                .map(|(s, m)| *m > limit.hypot(noise_share(s.energy_j, norm)))
                .collect();
            for (source, _) in patch.sources.iter().zip(&is_odd).filter(|(_, odd)| **odd) {
                found.push(Odd {
                    frame: patch.frame,
                    at: source.at,
                });
                for p in patch.near(camera, source.at, reach) {
                    patch.weight[p] = 0.0;
                }
            }
            let mut odd = is_odd.iter();
            patch.sources.retain(|_| !odd.next().expect("one flag a source"));
        }
        self.patches.retain(|p| !p.sources.is_empty());
        found
    }

    /// Goes on with the spot of a lens's pupil, whose wavefront is then what is learned.
    pub fn begin_wavefront(&mut self, pupil: Pupil) {
        let radius = FIRST_PUPIL_RADIUS * self.camera.spot_sigma_m;
        let knots = (2.0 * radius / self.model.knot_m) as usize;
        let like = self
            .model
            .widened((knots | 1).clamp(self.model.n, MOST_SPLINES.max(self.model.n)));
        self.adopt(like.with_pupil(pupil));
    }

    /// One step of the template and of everything else at once.
    pub fn step(&mut self, is_first: bool) {
        match self.model.pupil {
            Some(pupil) => {
                if let Some(model) = wavefront::step(self.camera, &self.model, pupil, &self.patches) {
                    self.model = model;
                }
            }
            None => solve::step(self.camera, &mut self.model, &mut self.patches, is_first),
        }
    }

    /// Whether light at the edge of a model's support matters.
    fn is_cut_short(&self, model: &TemplateModel) -> bool {
        let energies = self.patches.iter().flat_map(|p| &p.sources).map(|s| s.energy_j);
        let brightest = energies.fold(0.0, f64::max);
        constraints::light_at_edge(self.camera, model) * brightest > EDGE_LIGHT * self.noise_j
    }

    /// The model out to where its light ends to matter: a pupil's is known farther out than it was learned.
    pub fn as_far_as_seen(&self) -> TemplateModel {
        let mut model = self.model.clone();
        let half_m = self.camera.x.half_width().max(self.camera.y.half_width());
        while model.pupil.is_some() && model.radius_m() < 2.0 * half_m && self.is_cut_short(&model) {
            model = model.widened((GROWTH * model.n as f64) as usize | 1);
        }
        model
    }

    /// Rounds until χ² settles; the support grows while there is light at its edge.
    pub fn run(&mut self, rounds: usize, progress: &mut dyn FnMut(Round)) {
        let mut before = f64::INFINITY;
        let widest = WIDEST * self.camera.x.half_width().max(self.camera.y.half_width());
        for round in 0..rounds {
            self.fit(if round == 0 { 15 } else { 6 });
            if self.patches.is_empty() {
                return;
            }
            if round >= 2 && round % 2 == 0 && self.find_missing() > 0 {
                self.fit(8);
            }
            // From the start: two spots in one bend the template, and places that follow it lock to the pixels.
            self.mask_odd();
            if self.patches.is_empty() {
                return;
            }
            let chi2 = self.reduced_chi2();
            progress(Round {
                round,
                reduced_chi2: chi2,
                sources: self.sources(),
            });
            if round >= 3 && before - chi2 < SETTLED * chi2 {
                break;
            }
            before = chi2;
            self.step(round == 0 && self.model.degree == 0);
            let may_grow = self.model.degree == 0 || self.model.pupil.is_some();
            if (1..=3).contains(&round) && may_grow && self.is_cut_short(&self.model) {
                let wanted = (GROWTH * self.radius_m()).min(widest);
                let n = (2.0 * wanted / self.model.knot_m) as usize;
                let n = (n | 1).min(MOST_SPLINES);
                if n > self.model.n {
                    let wider = self.model.widened(n);
                    self.adopt(wider);
                    before = f64::INFINITY;
                }
            }
        }
    }

    /// The same spots on the same pixels, fitted with another model of the same support.
    pub fn refitted(&self, model: TemplateModel) -> Self {
        let mut other = self.of_patches(self.patches.clone());
        other.model = model;
        let (camera, model) = (other.camera, &other.model);
        other
            .patches
            .par_iter_mut()
            .for_each(|patch| patch.fit(camera, model, 15));
        other
    }

    /// The same images with other patches of them.
    pub fn of_patches(&self, patches: Vec<Patch>) -> Self {
        Self {
            model: self.model.clone(),
            patches,
            filter: MatchedFilter::new(self.camera),
            ..*self
        }
    }
}
