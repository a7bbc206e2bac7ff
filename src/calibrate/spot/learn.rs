//! The alternation of places and template (effective PSF: Anderson and King, 2000), with the template solved for as splines.

use rayon::prelude::*;

use super::detection::{self, MatchedFilter, Peak};
use super::grouping::{self, Image};
use super::patch::{Linearised, Patch, Source};
use super::solve;
use super::template_model::TemplateModel;
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
/// Most splines a side: what a matrix of them costs in each round.
const MOST_SPLINES: usize = 97;
/// Light at the edge that matters: of the brightest spot, in standard deviations of one pixel.
const EDGE_LIGHT: f64 = 0.3;
/// Support of what changes over the field, σ: aberrations that change widely are near the core.
const FIELD_RADIUS: f64 = 7.0;
/// Width of the margin over which the prior fades out, share of the support.
const TAPER: f64 = 0.2;
/// Rounds at most, and the relative fall of χ² per degree of freedom below which there are no more.
const ROUNDS: usize = 12;
const SETTLED: f64 = 1e-3;
/// Least matched signal-to-noise ratio of a source that a patch is used for.
const LEAST_SNR: f64 = 12.0;

/// State of the learning.
pub struct Learner<'a> {
    pub camera: &'a Camera,
    pub images: &'a [Image],
    pub noise_j: f64,
    pub model: TemplateModel,
    pub patches: Vec<Patch>,
    /// Share of a spot's norm that the template does not explain, median over the spots.
    pub misfit: f64,
    filter: MatchedFilter,
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
    pub fn new(camera: &'a Camera, images: &'a [Image], noise_j: f64) -> Self {
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
        images: &'a [Image],
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

    /// First sources: an unknown shape may have a quarter of its peak a few widths out and a twentieth further.
    fn detect(&mut self) {
        let (camera, noise) = (self.camera, self.noise_j);
        let sigma = camera.spot_sigma_m;
        let halo = |d: f64| match d / sigma {
            d if d < 6.0 => 0.25,
            d if d < 15.0 => 0.05,
            _ => 0.02,
        };
        let radius = self.radius_m();
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
                grouping::patches(camera, k, image, own.iter().map(source).collect(), radius)
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
            .flat_map_iter(|(k, sources)| grouping::patches(camera, k, &images[k], sources, radius))
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

    pub fn sources(&self) -> usize {
        self.patches.iter().map(|p| p.sources.len()).sum()
    }

    /// Misfit of each source: √(excess of χ² within a few widths over the spot's own), patch by patch.
    pub fn misfits(&self) -> Vec<Vec<f64>> {
        let (camera, model) = (self.camera, &self.model);
        let reach = 3.0 * camera.spot_sigma_m;
        self.patches
            .par_iter()
            .map(|patch| {
                let expected = patch.expected(camera, model);
                let of = |source: &Source| {
                    let (mut excess, mut own) = (0.0, 0.0);
                    for j in pixels(&camera.y, source.at[1], reach, &patch.y) {
                        for i in pixels(&camera.x, source.at[0], reach, &patch.x) {
                            let p = (j - patch.y.start) * patch.x.len() + i - patch.x.start;
                            let w = patch.weight[p];
                            if w > 0.0 {
                                excess += ((patch.data[p] - expected[p]) * w).powi(2) - 1.0;
                                own += ((expected[p] - patch.background) * w).powi(2);
                            }
                        }
                    }
                    (excess.max(0.0) / own.max(1.0)).sqrt()
                };
                patch.sources.iter().map(of).collect()
            })
            .collect()
    }

    fn median_misfit(&self) -> f64 {
        median(self.misfits().concat()).unwrap_or(0.0)
    }

    /// Adds spots that the residual shows; what a brighter spot's own misfit may look like is left alone.
    pub fn find_missing(&mut self) -> usize {
        let (camera, model, noise) = (self.camera, &self.model, self.noise_j);
        let share = (4.0 * self.misfit).clamp(0.01, 0.25);
        let near = 3.0 * camera.spot_sigma_m;
        let mut by_frame: Vec<Vec<&Patch>> = vec![Vec::new(); self.images.len()];
        for patch in &self.patches {
            by_frame[patch.frame].push(patch);
        }
        let found: Vec<(Vec<Source>, usize)> = by_frame
            .par_iter()
            .zip(self.images)
            .map(|(patches, image)| {
                let nx = camera.x.n;
                let mut residual: Vec<f64> = image.pixels.iter().map(|v| v - image.level).collect();
                for patch in patches {
                    let expected = patch.expected(camera, model);
                    for (row, line) in patch.y.clone().zip(expected.chunks_exact(patch.x.len())) {
                        let start = row * nx + patch.x.start;
                        for (o, e) in residual[start..].iter_mut().zip(line) {
                            *o = *o + image.level - e;
                        }
                    }
                }
                let used = image.weight.iter().map(|w| *w > 0.0);
                residual.iter_mut().zip(used).for_each(|(r, used)| {
                    if !used {
                        *r = 0.0
                    }
                });
                let known: Vec<Source> = patches.iter().flat_map(|p| p.sources.iter().cloned()).collect();
                let brighter: Vec<Peak> = known.iter().map(peak).collect();
                let peaks = self.filter.peaks(camera, &residual, noise);
                // A spot's core is where its misfit is.
                let halo = |d: f64| match d {
                    d if d < near => share,
                    d if d < self.radius_m() => share.min(0.05),
                    _ => 0.005,
                };
                let own = detection::own_spots(&peaks, &brighter, halo);
                let count = own.len();
                (known.into_iter().chain(own.iter().map(source)).collect(), count)
            })
            .collect();
        let added = found.iter().map(|f| f.1).sum();
        if added > 0 {
            self.cut(found.into_iter().map(|f| f.0).collect());
        }
        added
    }

    /// Takes pixels out of use around spots that the template does not explain although it explains most: two in one, a saturated
    /// one, something that is no spot. Returns their number.
    pub fn mask_odd(&mut self) -> usize {
        let limit = (4.0 * self.misfit).max(0.02);
        let camera = self.camera;
        let reach = 4.0 * camera.spot_sigma_m;
        let noise_share = |e: f64, norm: f64| 4.0 * self.noise_j / (e * norm);
        let norm = norm(camera, &self.model);
        let misfits = self.misfits();
        let mut count = 0;
        for (patch, misfits) in self.patches.iter_mut().zip(misfits) {
            let is_odd: Vec<bool> = patch
                .sources
                .iter()
                .zip(&misfits)
                .map(|(s, m)| *m > limit.hypot(noise_share(s.energy_j, norm)))
                .collect();
            for (source, _) in patch.sources.iter().zip(&is_odd).filter(|(_, odd)| **odd) {
                count += 1;
                for j in pixels(&camera.y, source.at[1], reach, &patch.y) {
                    for i in pixels(&camera.x, source.at[0], reach, &patch.x) {
                        patch.weight[(j - patch.y.start) * patch.x.len() + i - patch.x.start] = 0.0;
                    }
                }
            }
            let mut odd = is_odd.iter();
            patch.sources.retain(|_| !odd.next().expect("one flag a source"));
        }
        self.patches.retain(|p| !p.sources.is_empty());
        count
    }

    /// Inverse prior variances of the coefficients: three times what the template has at that distance, fading at the edge.
    fn prior(&self, is_first: bool) -> Vec<f64> {
        let model = &self.model;
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

    /// One step of the template and of everything else at once.
    pub fn step(&mut self, is_first: bool) {
        let (camera, model) = (self.camera, &self.model);
        let prior = self.prior(is_first);
        let linear: Vec<(&Patch, Linearised)> = self
            .patches
            .par_iter()
            .filter_map(|patch| patch.linearise(camera, model).map(|l| (patch, l)))
            .collect();
        let step = solve::template_step(model, &linear, &prior);
        drop(linear);
        let mut model = self.model.clone();
        model.coefficients.iter_mut().zip(&step).for_each(|(c, s)| *c += s);
        let shift = centre(&mut model, camera.spot_sigma_m);
        let light = model.normalise();
        for patch in &mut self.patches {
            for source in &mut patch.sources {
                let values = model.field_values(source.at);
                source.energy_j *= light(&values);
                let moved = shift(&values);
                (0..2).for_each(|k| source.at[k] += moved[k]);
            }
        }
        self.model = model;
    }

    /// Whether light at the edge of the support matters, and there is room for more.
    fn is_cut_short(&self) -> bool {
        let model = &self.model;
        let n = model.n;
        let brightest = self
            .patches
            .iter()
            .flat_map(|p| &p.sources)
            .map(|s| s.energy_j)
            .fold(0.0, f64::max);
        // By octants: a tail may point one way, and the mean of many splines is free of their noise.
        let (mut sum, mut count) = ([0.0f64; 8], [0.0f64; 8]);
        for j in 0..n {
            for i in 0..n {
                let (x, y) = (model.knot(i), model.knot(j));
                if (0.6..0.8).contains(&(x.hypot(y) / model.radius_m())) {
                    let octant = usize::from(x > 0.0) + 2 * usize::from(y > 0.0) + 4 * usize::from(x.abs() > y.abs());
                    sum[octant] += model.coefficients[j * n + i];
                    count[octant] += 1.0;
                }
            }
        }
        let means = sum.iter().zip(count).map(|(s, c)| s.abs() / c.max(1.0));
        let pixel = self.camera.x.pitch_m * self.camera.y.pitch_m / model.knot_m.powi(2);
        let per_pixel = pixel * means.fold(0.0, f64::max);
        per_pixel * brightest > EDGE_LIGHT * self.noise_j
    }

    /// Rounds until χ² settles; the support grows while there is light at its edge.
    pub fn run(&mut self, rounds: usize, progress: &mut dyn FnMut(Round)) {
        let mut before = f64::INFINITY;
        let widest = 0.9 * self.camera.x.half_width().max(self.camera.y.half_width());
        for round in 0..rounds {
            self.fit(if round == 0 { 15 } else { 6 });
            if self.patches.is_empty() {
                return;
            }
            if round >= 2 && round % 2 == 0 && self.find_missing() > 0 {
                self.fit(8);
            }
            if round >= 2 {
                self.mask_odd();
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
            if (1..=3).contains(&round) && self.model.degree == 0 && self.is_cut_short() {
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

    /// Half the support of what changes over the field, m.
    pub fn field_radius_m(&self) -> f64 {
        FIELD_RADIUS * self.camera.spot_sigma_m
    }

    /// The same spots on the same pixels, fitted with another model of the same support.
    pub fn refitted(&self, model: TemplateModel) -> Self {
        let mut other = Self {
            model,
            patches: self.patches.clone(),
            filter: MatchedFilter::new(self.camera),
            ..*self
        };
        let (camera, model) = (other.camera, &other.model);
        other
            .patches
            .par_iter_mut()
            .for_each(|patch| patch.fit(camera, model, 15));
        other
    }

    /// Standard deviation of most pixels' weighted residuals, 1 where the noise is as assumed.
    pub fn residual_scale(&self) -> f64 {
        let (camera, model) = (self.camera, &self.model);
        let magnitudes = self.patches.iter().flat_map(|patch| {
            let expected = patch.expected(camera, model).into_iter().zip(&patch.data);
            let weighted = expected.zip(&patch.weight).filter(|(_, w)| **w > 0.0);
            weighted.map(|((e, d), w)| ((d - e) * w).abs()).collect::<Vec<f64>>()
        });
        // A median magnitude is 0.6745 standard deviations of a Gaussian.
        median(magnitudes.collect()).map_or(1.0, |m| m / 0.6745).max(1e-6)
    }

    /// Matched signal-to-noise ratio of all spots together.
    pub fn information(&self) -> f64 {
        let energies = self.patches.iter().flat_map(|p| &p.sources).map(|s| s.energy_j.powi(2));
        energies.sum::<f64>().sqrt() * norm(self.camera, &self.model) / self.noise_j
    }

    /// Signal-to-noise ratio of the brightest pixel of a spot in the middle of a pixel: median and largest over the spots.
    pub fn peak_snr(&self) -> [f64; 2] {
        let model = &self.model;
        let peak = model.coefficients[..model.n * model.n]
            .iter()
            .fold(0.0f64, |a, b| a.max(*b));
        let pixel = self.camera.x.pitch_m * self.camera.y.pitch_m / model.knot_m.powi(2);
        let energies: Vec<f64> = self
            .patches
            .iter()
            .flat_map(|p| &p.sources)
            .map(|s| s.energy_j)
            .collect();
        let largest = energies.iter().copied().fold(0.0, f64::max);
        [median(energies).unwrap_or(0.0), largest].map(|e| e * (peak * pixel).min(1.0) / self.noise_j)
    }
}

/// Default number of rounds.
pub const MOST_ROUNDS: usize = ROUNDS;

fn source(peak: &Peak) -> Source {
    Source {
        at: peak.at,
        energy_j: peak.energy_j,
    }
}

fn peak(source: &Source) -> Peak {
    Peak {
        at: source.at,
        energy_j: source.energy_j,
    }
}

fn pixels(axis: &crate::optics::Axis, at: f64, reach: f64, within: &std::ops::Range<usize>) -> std::ops::Range<usize> {
    let near = super::template_model::pixels_within(axis, at, reach);
    near.start.max(within.start)..near.end.min(within.end)
}

/// √Σ over the pixels of a unit-energy spot's square, about.
pub fn norm(camera: &Camera, model: &TemplateModel) -> f64 {
    let n = model.n;
    let area = model.knot_m.powi(2) / (camera.x.pitch_m * camera.y.pitch_m);
    (model.coefficients[..n * n].iter().map(|c| c * c).sum::<f64>() / area).sqrt()
}

/// Brings the centroid under a Gaussian window to zero, to first order in the shift; returns the shift of places with the given field
/// values, m.
fn centre(model: &mut TemplateModel, sigma_m: f64) -> impl Fn(&[f64]) -> [f64; 2] + use<> {
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
