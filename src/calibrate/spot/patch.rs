//! A rectangle of one frame with all spots that leave light in it, and the fit of their places and energies.

use std::ops::Range;

use faer::Mat;

use super::band::{Band, Scratch, adjoint, forward, pixels_within};
use super::template_model::TemplateModel;
use crate::calibrate::exposure::ScaledCholesky;
use crate::optics::Camera;

/// One light source.
#[derive(Clone, Debug)]
pub struct Source {
    pub at: [f64; 2],
    pub energy_j: f64,
}

/// Pixels x × y of a frame; no source of another patch of the frame leaves modelled light in it.
#[derive(Clone, Debug)]
pub struct Patch {
    /// Index of the frame in the list that is learned from.
    pub frame: usize,
    pub x: Range<usize>,
    pub y: Range<usize>,
    /// J, row by row.
    pub data: Vec<f64>,
    /// 1/σ of a pixel, 1/J; zero where it is not used.
    pub weight: Vec<f64>,
    pub sources: Vec<Source>,
    /// Level per pixel, J.
    pub background: f64,
    pub chi2: f64,
}

/// Parameters a source: x, y, energy.
const PER_SOURCE: usize = 3;
/// Half-width of the square within which a source's misfit is measured, σ.
const MISFIT_REACH: f64 = 3.0;

/// The weighted Jacobian of a patch by its own parameters, and what the template needs at its present places.
pub struct Linearised {
    /// Weighted residual.
    pub residual: Vec<f64>,
    /// Weighted derivatives by x, y and energy of each source, on the pixels of its bands.
    own: Vec<[Vec<f64>; PER_SOURCE]>,
    /// 1/σ: the derivative by the background.
    weight: Vec<f64>,
    gram: Mat<f64>,
    solver: ScaledCholesky,
    bands: Vec<[Band; 2]>,
    field_values: Vec<Vec<f64>>,
}

impl Patch {
    pub fn pixels(&self) -> usize {
        self.data.len()
    }

    pub fn used(&self) -> usize {
        self.weight.iter().filter(|w| **w > 0.0).count()
    }

    pub fn degrees_of_freedom(&self) -> usize {
        self.used().saturating_sub(PER_SOURCE * self.sources.len() + 1)
    }

    /// Adds an image on the bands of a source, times `scale`, to one on the patch.
    fn place(&self, bands: &[Band; 2], image: &[f64], scale: f64, out: &mut [f64]) {
        let nx = bands[0].pixels.len();
        let x0 = bands[0].pixels.start - self.x.start;
        for (k, row) in image.chunks_exact(nx.max(1)).enumerate() {
            let start = (bands[1].pixels.start - self.y.start + k) * self.x.len() + x0;
            for (o, v) in out[start..start + nx].iter_mut().zip(row) {
                *o += scale * v;
            }
        }
    }

    /// The part of an image on the patch that lies on the bands of a source.
    fn cut(&self, bands: &[Band; 2], image: &[f64], out: &mut Vec<f64>) {
        let nx = bands[0].pixels.len();
        let x0 = bands[0].pixels.start - self.x.start;
        out.clear();
        if nx == 0 {
            return;
        }
        for k in bands[1].pixels.clone() {
            let start = (k - self.y.start) * self.x.len() + x0;
            out.extend_from_slice(&image[start..start + nx]);
        }
    }

    fn bands(&self, camera: &Camera, model: &TemplateModel, at: [f64; 2]) -> [Band; 2] {
        let clip = |mut band: Band, range: &Range<usize>| {
            band.clip(range);
            band
        };
        [
            clip(Band::new(&camera.x, at[0], model.n, model.knot_m), &self.x),
            clip(Band::new(&camera.y, at[1], model.n, model.knot_m), &self.y),
        ]
    }

    /// Expected value of every pixel, J.
    pub fn expected(&self, camera: &Camera, model: &TemplateModel) -> Vec<f64> {
        let mut out = vec![self.background; self.pixels()];
        let (mut scratch, mut splines, mut image) = (Scratch::default(), Vec::new(), Vec::new());
        for source in &self.sources {
            let bands = self.bands(camera, model, source.at);
            model.local(&model.coefficients, &model.field_values(source.at), &mut splines);
            forward(
                &splines,
                model.n,
                [&bands[0], &bands[1]],
                [false; 2],
                &mut scratch,
                &mut image,
            );
            self.place(&bands, &image, source.energy_j, &mut out);
        }
        out
    }

    /// Weighted χ² at the present parameters.
    fn cost(&self, camera: &Camera, model: &TemplateModel) -> f64 {
        let expected = self.expected(camera, model);
        let terms = expected.iter().zip(&self.data).zip(&self.weight);
        terms.map(|((e, d), w)| ((d - e) * w).powi(2)).sum()
    }

    pub fn linearise(&self, camera: &Camera, model: &TemplateModel) -> Option<Linearised> {
        let columns = PER_SOURCE * self.sources.len() + 1;
        let mut jacobian = Mat::<f64>::zeros(self.pixels(), columns);
        let mut expected = vec![self.background; self.pixels()];
        let (mut scratch, mut splines, mut image) = (Scratch::default(), Vec::new(), Vec::new());
        let (mut all_bands, mut field_values) = (Vec::new(), Vec::new());
        for (i, source) in self.sources.iter().enumerate() {
            let bands = self.bands(camera, model, source.at);
            let values = model.field_values(source.at);
            model.local(&model.coefficients, &values, &mut splines);
            for (k, slope) in [[true, false], [false, true], [false, false]].into_iter().enumerate() {
                forward(
                    &splines,
                    model.n,
                    [&bands[0], &bands[1]],
                    slope,
                    &mut scratch,
                    &mut image,
                );
                let scale = if k < 2 { source.energy_j } else { 1.0 };
                self.place(&bands, &image, scale, jacobian.col_as_slice_mut(PER_SOURCE * i + k));
            }
            self.place(&bands, &image, source.energy_j, &mut expected);
            all_bands.push(bands);
            field_values.push(values);
        }
        jacobian.col_as_slice_mut(columns - 1).fill(1.0);
        for c in 0..columns {
            let column = jacobian.col_as_slice_mut(c);
            column.iter_mut().zip(&self.weight).for_each(|(v, w)| *v *= w);
        }
        let terms = expected.iter().zip(&self.data).zip(&self.weight);
        let residual = terms.map(|((e, d), w)| (d - e) * w).collect();
        let gram = jacobian.transpose() * &jacobian;
        // Beyond its bands a source has no light: there its columns are zero and not kept.
        let own = all_bands.iter().enumerate().map(|(i, bands)| {
            std::array::from_fn(|k| {
                let mut window = Vec::new();
                self.cut(bands, jacobian.col_as_slice(PER_SOURCE * i + k), &mut window);
                window
            })
        });
        Some(Linearised {
            residual,
            solver: ScaledCholesky::new(&gram, 1e-10)?,
            gram,
            own: own.collect(),
            weight: self.weight.clone(),
            bands: all_bands,
            field_values,
        })
    }

    /// Indices of the pixels within `reach_m` of a place along both axes.
    pub fn near(&self, camera: &Camera, at: [f64; 2], reach_m: f64) -> Vec<usize> {
        let (nx, x0, y0) = (self.x.len(), self.x.start, self.y.start);
        let within = |near: Range<usize>, range: &Range<usize>| near.start.max(range.start)..near.end.min(range.end);
        let columns = within(pixels_within(&camera.x, at[0], reach_m), &self.x);
        let rows = within(pixels_within(&camera.y, at[1], reach_m), &self.y);
        rows.flat_map(|j| columns.clone().map(move |i| (j - y0) * nx + i - x0))
            .collect()
    }

    /// Misfit of each source: √(excess of χ² within a few widths over the spot's own).
    pub fn misfits(&self, camera: &Camera, model: &TemplateModel) -> Vec<f64> {
        let expected = self.expected(camera, model);
        let of = |source: &Source| {
            let (mut excess, mut own) = (0.0, 0.0);
            for p in self.near(camera, source.at, MISFIT_REACH * camera.spot_sigma_m) {
                let w = self.weight[p];
                if w > 0.0 {
                    excess += ((self.data[p] - expected[p]) * w).powi(2) - 1.0;
                    own += ((expected[p] - self.background) * w).powi(2);
                }
            }
            (excess.max(0.0) / own.max(1.0)).sqrt()
        };
        self.sources.iter().map(of).collect()
    }

    /// Levenberg–Marquardt (Marquardt, 1963) on places, energies and background with the template held fixed.
    pub fn fit(&mut self, camera: &Camera, model: &TemplateModel, steps: usize) {
        let reach = 0.5 * camera.spot_sigma_m;
        let mut damping = 1e-4;
        let Some(mut now) = self.linearise(camera, model) else {
            return;
        };
        self.chi2 = square(&now.residual);
        for _ in 0..steps {
            let Some(solver) = ScaledCholesky::new(&now.gram, damping) else {
                break;
            };
            let mut step = solver.solve(&now.against(self, &now.residual));
            let places = step.chunks(PER_SOURCE).take(self.sources.len());
            let longest = places.map(|d| d[0].hypot(d[1])).fold(0.0, f64::max);
            if longest > reach {
                step.iter_mut().for_each(|d| *d *= reach / longest);
            }
            let before = (self.sources.clone(), self.background);
            self.step(camera, &step);
            let cost = self.cost(camera, model);
            if cost < self.chi2 {
                let gained = self.chi2 - cost;
                self.chi2 = cost;
                damping = (damping * 0.1).max(1e-10);
                if gained < 1e-3 + 1e-9 * cost {
                    break;
                }
                let Some(next) = self.linearise(camera, model) else {
                    break;
                };
                now = next;
            } else {
                (self.sources, self.background) = before;
                damping *= 10.0;
                if damping > 1e3 {
                    break;
                }
            }
        }
    }

    /// Adds a step of the parameters, kept near the patch.
    pub fn step(&mut self, camera: &Camera, step: &[f64]) {
        let limits = [(&camera.x, &self.x), (&camera.y, &self.y)];
        for (source, d) in self.sources.iter_mut().zip(step.chunks_exact(PER_SOURCE)) {
            for (k, (axis, range)) in limits.iter().enumerate() {
                let margin = 1.5 * camera.spot_sigma_m;
                let (lo, hi) = (axis.edge(range.start) - margin, axis.edge(range.end) + margin);
                source.at[k] = (source.at[k] + d[k]).clamp(lo, hi);
            }
            source.energy_j = (source.energy_j + d[2]).max(0.0);
        }
        self.background += step[step.len() - 1];
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn square(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum()
}

impl Linearised {
    /// Jᵀ r.
    fn against(&self, patch: &Patch, weighted: &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(PER_SOURCE * self.own.len() + 1);
        let mut window = Vec::new();
        for (columns, bands) in self.own.iter().zip(&self.bands) {
            patch.cut(bands, weighted, &mut window);
            out.extend(columns.iter().map(|column| dot(column, &window)));
        }
        out.push(dot(&self.weight, weighted));
        out
    }

    /// Removes what the patch's own parameters explain of a weighted residual.
    pub fn project(&self, patch: &Patch, weighted: &mut [f64]) {
        let step = self.solver.solve(&self.against(patch, weighted));
        for ((columns, bands), step) in self.own.iter().zip(&self.bands).zip(step.chunks_exact(PER_SOURCE)) {
            for (column, s) in columns.iter().zip(step) {
                patch.place(bands, column, -s, weighted);
            }
        }
        let background = step[step.len() - 1];
        weighted
            .iter_mut()
            .zip(&self.weight)
            .for_each(|(v, w)| *v -= background * w);
    }

    /// The weighted Jacobian J by places, energies and background, and (JᵀJ)⁻¹Jᵀ.
    pub fn jacobian_and_inverse(&self, patch: &Patch) -> (Mat<f64>, Mat<f64>) {
        let columns = PER_SOURCE * self.own.len() + 1;
        let mut jacobian = Mat::<f64>::zeros(patch.pixels(), columns);
        for (i, (own, bands)) in self.own.iter().zip(&self.bands).enumerate() {
            for (k, column) in own.iter().enumerate() {
                patch.place(bands, column, 1.0, jacobian.col_as_slice_mut(PER_SOURCE * i + k));
            }
        }
        jacobian.col_as_slice_mut(columns - 1).copy_from_slice(&self.weight);
        let inverse = self.solver.solve_many(&jacobian.transpose().to_owned());
        (jacobian, inverse)
    }

    /// Weighted change of the pixels when the template's coefficients change.
    pub fn template_change(
        &self,
        patch: &Patch,
        model: &TemplateModel,
        change: &[f64],
        buffers: &mut Buffers,
    ) -> Vec<f64> {
        let mut out = vec![0.0; patch.pixels()];
        for i in 0..patch.sources.len() {
            self.source_change(patch, model, i, change, buffers, &mut out);
        }
        out.iter_mut().zip(&patch.weight).for_each(|(o, w)| *o *= w);
        out
    }

    /// The change of the pixels, J, that one source's own makes, added to `out`.
    pub fn source_change(
        &self,
        patch: &Patch,
        model: &TemplateModel,
        i: usize,
        change: &[f64],
        buffers: &mut Buffers,
        out: &mut [f64],
    ) {
        let bands = &self.bands[i];
        model.local(change, &self.field_values[i], &mut buffers.splines);
        forward(
            &buffers.splines,
            model.n,
            [&bands[0], &bands[1]],
            [false; 2],
            &mut buffers.scratch,
            &mut buffers.image,
        );
        patch.place(bands, &buffers.image, patch.sources[i].energy_j, out);
    }

    /// The adjoint of [`Self::template_change`], added to `gradient`; `weighted` is used up.
    pub fn gradient(
        &self,
        patch: &Patch,
        model: &TemplateModel,
        weighted: &mut [f64],
        buffers: &mut Buffers,
        gradient: &mut [f64],
    ) {
        weighted.iter_mut().zip(&patch.weight).for_each(|(v, w)| *v *= w);
        for ((source, bands), values) in patch.sources.iter().zip(&self.bands).zip(&self.field_values) {
            patch.cut(bands, weighted, &mut buffers.image);
            let pair = [&bands[0], &bands[1]];
            adjoint(
                &buffers.image,
                model.n,
                pair,
                &mut buffers.scratch,
                &mut buffers.splines,
            );
            buffers.splines.iter_mut().for_each(|v| *v *= source.energy_j);
            model.local_adjoint(&buffers.splines, values, gradient);
        }
    }

    /// p_c at each source.
    pub fn field_values(&self) -> &[Vec<f64>] {
        &self.field_values
    }
}

/// Buffers that one thread uses again and again.
#[derive(Default)]
pub struct Buffers {
    scratch: Scratch,
    splines: Vec<f64>,
    image: Vec<f64>,
}
