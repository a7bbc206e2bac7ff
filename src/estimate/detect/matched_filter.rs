//! The matched filter on a fine grid and its maxima: non-maximum suppression, sub-grid peaks.

use crate::estimate::dense_linalg::dispatch;
use crate::estimate::detect::templates::Templates;
use crate::estimate::model::svd_basis::Basis;

/// A maximum of the response.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Peak {
    /// Sub-pixel position, σ.
    pub u: [f64; 2],
    /// Matched-filter response over its standard deviation.
    pub significance: f64,
    /// Energy a lone spot would have there, in units of the noise.
    pub a: f64,
}

/// The matched filter: unit-norm spots on a grid, in the bases.
pub(crate) struct MatchedFilter {
    templates: [Templates; 2],
    /// Where pixels have weights.
    squares: Option<[Templates; 2]>,
    /// Response over its standard deviation, (grid y, grid x).
    map: Vec<f64>,
    /// Factor on each response that made its standard deviation one; empty where all pixels have the same weight.
    scale: Vec<f64>,
    strip: Vec<f64>,
    line: Vec<f64>,
    peaks: Vec<Peak>,
}

impl MatchedFilter {
    pub fn new(bx: &Basis, by: &Basis) -> Self {
        Self {
            templates: [bx, by].map(Templates::new),
            squares: None,
            map: Vec::new(),
            scale: Vec::new(),
            strip: Vec::new(),
            line: Vec::new(),
            peaks: Vec::new(),
        }
    }

    /// Peaks of `residual` (my, mx) of at least `threshold` standard deviations, no two nearer than `radius` σ,
    /// strongest first.
    pub fn peaks(&mut self, residual: &[f64], mx: usize, my: usize, threshold: f64, radius: f64) -> &[Peak] {
        self.respond(residual, mx, my);
        self.find(threshold, radius)
    }

    /// Fills the map with the response to `residual`.
    pub fn respond(&mut self, residual: &[f64], mx: usize, my: usize) {
        dispatch!(<'a>
            matched_filter: &'a mut MatchedFilter = self,
            residual: &'a [f64] = residual,
            mx: usize = mx,
            my: usize = my
            => (): matched_filter.filter(residual, mx, my));
    }

    /// Peaks of `residual` where pixels have the inverse variances `weights`, (my, mx), which the residual already carries: each response is
    /// divided by its own standard deviation. Only in the pixel bases.
    pub fn weighted_peaks(
        &mut self,
        residual: &[f64],
        weights: &[f64],
        [mx, my]: [usize; 2],
        threshold: f64,
        radius: f64,
    ) -> &[Peak] {
        self.respond(residual, mx, my);
        let templates = &self.templates;
        self.squares
            .get_or_insert_with(|| templates.each_ref().map(Templates::squared));
        dispatch!(<'a>
            matched_filter: &'a mut MatchedFilter = self,
            weights: &'a [f64] = weights,
            mx: usize = mx,
            my: usize = my
            => (): matched_filter.normalise(weights, mx, my));
        self.find(threshold, radius)
    }

    /// Divides the map by the standard deviation of each response under `weights`.
    #[inline(always)]
    fn normalise(&mut self, weights: &[f64], mx: usize, my: usize) {
        let Some([along_x, along_y]) = &self.squares else {
            return;
        };
        let nx = along_x.points.len();
        self.scale.resize(self.map.len(), 0.0);
        let rows = self.map.chunks_exact_mut(nx).zip(self.scale.chunks_exact_mut(nx));
        for (j, (out, scale)) in rows.enumerate() {
            along_y.sum_rows(j, weights, [mx, my], &mut self.strip);
            along_x.respond(&self.strip, &mut self.line);
            for ((out, scale), variance) in out.iter_mut().zip(scale).zip(&self.line) {
                let std = variance.sqrt();
                *scale = if *variance > 0.0 { 1.0 / std } else { 0.0 };
                *out *= *scale;
            }
        }
    }

    /// Subtracts from each response what stands on its sides at this distance, σ, as far as they are on the grid, and leaves it as uncertain
    /// as it was. What is smooth over the sensor vanishes. NaN where there are none.
    pub fn subtract_sides(&mut self, distance: f64) {
        let [nx, ny] = [0, 1].map(|k| self.points(k).len());
        let [dx, dy] = [0, 1].map(|k| (distance / (self.points(k)[1] - self.points(k)[0])).round() as usize);
        let map = std::mem::take(&mut self.map);
        let at = |i: usize, j: usize| map[j * nx + i];
        self.map = (0..ny)
            .flat_map(|j| (0..nx).map(move |i| (i, j)))
            .map(|(i, j)| {
                let along_x = (i >= dx && i + dx < nx).then(|| at(i - dx, j) + at(i + dx, j));
                let along_y = (j >= dy && j + dy < ny).then(|| at(i, j - dy) + at(i, j + dy));
                let count = 2.0 * [along_x, along_y].iter().flatten().count() as f64;
                let sides = along_x.unwrap_or(0.0) + along_y.unwrap_or(0.0);
                (at(i, j) - sides / count) / (1.0 + 1.0 / count).sqrt()
            })
            .collect();
    }

    /// Response at a position, σ, by bilinear interpolation of the map; `None` outside the grid.
    pub fn response_at(&self, u: [f64; 2]) -> Option<f64> {
        let mut cell = [(0, 0.0); 2];
        for k in 0..2 {
            let grid = self.points(k);
            let position = (u[k] - grid[0]) / (grid[1] - grid[0]);
            if !(position >= 0.0 && position <= (grid.len() - 1) as f64) {
                return None;
            }
            let index = (position as usize).min(grid.len() - 2);
            cell[k] = (index, position - index as f64);
        }
        let [(i, s), (j, t)] = cell;
        let at = |i: usize, j: usize| self.map[j * self.points(0).len() + i];
        let along = |j: usize| at(i, j) * (1.0 - s) + at(i + 1, j) * s;
        Some(along(j) * (1.0 - t) + along(j + 1) * t)
    }

    #[inline(always)]
    fn filter(&mut self, residual: &[f64], mx: usize, my: usize) {
        let [along_x, along_y] = &self.templates;
        let nx = along_x.points.len();
        self.map.resize(nx * along_y.points.len(), 0.0);
        self.scale.clear();
        for (j, out) in self.map.chunks_exact_mut(nx).enumerate() {
            along_y.sum_rows(j, residual, [mx, my], &mut self.strip);
            along_x.respond(&self.strip, &mut self.line);
            out.copy_from_slice(&self.line[..nx]);
        }
    }

    /// Response along one axis, 0 for x, to a profile along it, at each of the axis' grid points: a spot's response is the product of two.
    pub fn respond_along(&self, axis: usize, profile: &[f64]) -> Vec<f64> {
        let mut responses = Vec::new();
        self.templates[axis].respond(profile, &mut responses);
        responses.truncate(self.templates[axis].points.len());
        responses
    }

    /// Response over its standard deviation at every grid point.
    pub fn map(&self) -> &[f64] {
        &self.map
    }

    /// Positions of the grid's points along an axis, σ.
    fn points(&self, axis: usize) -> &[f64] {
        &self.templates[axis].points
    }

    /// Points of the grid along x.
    pub fn width(&self) -> usize {
        self.points(0).len()
    }

    /// Position of a point of the map, σ.
    pub fn position(&self, index: usize) -> [f64; 2] {
        let nx = self.width();
        [self.points(0)[index % nx], self.points(1)[index / nx]]
    }

    /// Peaks of the map as it is; see `peaks`.
    pub fn find(&mut self, threshold: f64, radius: f64) -> &[Peak] {
        let (nx, ny) = (self.points(0).len(), self.points(1).len());
        self.peaks.clear();
        let at = |i: usize, j: usize| self.map[j * nx + i];
        for (j, row) in self.map.chunks_exact(nx).enumerate() {
            for (i, &value) in row.iter().enumerate() {
                if !(value >= threshold) {
                    continue;
                }
                // Of equal neighbours the first is the peak.
                let (lo, hi) = (i.saturating_sub(1), (i + 1).min(nx - 1));
                let is_peak = (i == 0 || row[lo] < value)
                    && (i == hi || row[hi] <= value)
                    && (j == 0 || (lo..=hi).all(|a| at(a, j - 1) < value))
                    && (j + 1 == ny || (lo..=hi).all(|a| at(a, j + 1) <= value));
                if !is_peak {
                    continue;
                }
                let vertex = |lo: Option<f64>, hi: Option<f64>| match (lo, hi) {
                    (Some(lo), Some(hi)) if lo + hi - 2.0 * value < 0.0 => {
                        (0.5 * (lo - hi) / (lo + hi - 2.0 * value)).clamp(-0.5, 0.5)
                    }
                    _ => 0.0,
                };
                let dx = vertex(i.checked_sub(1).map(|a| at(a, j)), (i + 1 < nx).then(|| at(i + 1, j)));
                let dy = vertex(j.checked_sub(1).map(|b| at(i, b)), (j + 1 < ny).then(|| at(i, j + 1)));
                let step = |g: &[f64]| g[1] - g[0];
                self.peaks.push(Peak {
                    u: [
                        self.points(0)[i] + dx * step(self.points(0)),
                        self.points(1)[j] + dy * step(self.points(1)),
                    ],
                    significance: value,
                    a: value * self.scale.get(j * nx + i).unwrap_or(&1.0)
                        / (self.templates[0].norms[i] * self.templates[1].norms[j]),
                });
            }
        }
        self.peaks.sort_by(|a, b| b.significance.total_cmp(&a.significance));
        let mut kept = 0;
        for k in 0..self.peaks.len() {
            let peak = self.peaks[k];
            let is_alone = self.peaks[..kept]
                .iter()
                .all(|p| (p.u[0] - peak.u[0]).powi(2) + (p.u[1] - peak.u[1]).powi(2) >= radius * radius);
            if is_alone {
                self.peaks[kept] = peak;
                kept += 1;
            }
        }
        self.peaks.truncate(kept);
        &self.peaks
    }
}
