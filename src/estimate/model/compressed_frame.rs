//! A frame's coefficients in the two bases, with weights and masked pixels: the data of a fit.

use crate::estimate::dense_linalg::{combine, dispatch, dot, largest};
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::masked_pixels::{MaskedPixel, MaskedPixels};
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::optics::{Camera, DisplacedSpots};

/// Largest part of the brightest spot that may be left outside the basis, in units of the noise: less costs columns, more biases
/// positions by 2 % of their standard deviation and more.
const LOSS: f64 = 0.02;
/// Largest error of a smeared spot in units of the noise, at the brightest pixel: less costs a fit with the square of the displaced spots,
/// more passes for another shape. A frame's score of 4096 pixels with nine spots then grows by less than one.
const SMEAR_LOSS: f64 = 0.1;
/// Standard deviations by which the smear changes the brightest spot from which on it is fitted: less costs a fit four to nine times as much in
/// more frames, more passes for another shape.
const NOTICEABLE: f64 = 1.0;
/// Most emitters of a frame: bounds time and memory whatever the frame shows.
const MAX_SOURCES: usize = 80;
/// Excess of the deviance up to which noise alone explains it. Larger leaves faint sources unfound, smaller searches frames again.
const MOST_EXCESS: f64 = 2.5;
/// Variances of which one logarithm is taken: their product stays finite.
const AT_ONCE: usize = 8;

/// Coefficients of a preprocessed frame and the statistics of the rest of it.
#[derive(Clone, Default)]
pub(crate) struct CompressedFrame {
    /// Columns in use along each axis, and their next multiples of 4.
    pub rank: [usize; 2],
    pub mx: usize,
    pub my: usize,
    /// (my, mx) row-major.
    pub coefficients: Vec<f64>,
    pub masked: MaskedPixels,
    /// Inverse variances (my, mx) where pixels differ in them, and Σ ln of the variances. Only in the pixel bases.
    pub weights: Vec<f64>,
    pub log_det: f64,
    /// Where the weights allow for an inexact PSF: the square of each weight times the variance that the pixel adds to positions. A spot's
    /// own halo is left out, since what is symmetric about it does not move it.
    pub position_weights: Vec<f64>,
    /// Whether every pixel has a weight, as a measured PSF needs it: masked pixels then weigh nothing, and there is nothing to downdate.
    pub is_weighted: bool,
    weighted: Vec<f64>,
    /// Beyond this many of its widths a spot is below the noise.
    pub reach: f64,
    /// Number of data of the fit: coefficients, or usable pixels where those are fewer.
    pub data_count: f64,
    /// Mean square outside the basis, and the number of data there.
    pub outside: (f64, f64),
    /// The variance as a function of the light, its mean over the frame, and its mean weighted by the light.
    pub variance: VarianceFunction,
    pub mean_variance: f64,
    pub light_weighted_variance: f64,
    pub smear: Option<DisplacedSpots>,
    /// Share of a spot's light by which the smeared spots may differ from their model; zero where noise hides that.
    pub unevenness: f64,
    /// Added to [`MOST_EXCESS`] where the frame is one of many windows: more of them have an excess by chance.
    pub spare_excess: f64,
    rows: Vec<f64>,
}

impl CompressedFrame {
    /// For frames of a camera whose PSF may be measured.
    pub fn of_camera(camera: &Camera) -> Self {
        Self {
            is_weighted: camera.spot_shape.is_some(),
            ..Self::default()
        }
    }

    /// Compresses `frame`, Z = Uᵧᵀ Y Uₓ.
    pub fn load(&mut self, frame: &PreprocessedFrame, bx: &Basis, by: &Basis) {
        dispatch!(<'a>
            compressed: &'a mut CompressedFrame = self,
            frame: &'a PreprocessedFrame = frame,
            bx: &'a Basis = bx,
            by: &'a Basis = by
            => (): compressed.read(frame, bx, by));
    }

    #[inline(always)]
    fn read(&mut self, frame: &PreprocessedFrame, bx: &Basis, by: &Basis) {
        let (nx, ny) = (bx.n, by.n);
        let brightest = largest(1.0, &frame.pixels);
        // The brightest pixel bounds every amplitude: A ≤ peak / (largest pixel fraction)².
        let fraction = |b: &Basis| (b.pitch() / (2.0 * std::f64::consts::PI).sqrt()).min(1.0);
        let amplitude = brightest / (fraction(bx) * fraction(by));
        self.reach = (2.0 * (amplitude / LOSS).max(1.0).ln())
            .sqrt()
            .clamp(3.0, psf_table::REACH);
        let norm = |b: &Basis| (b.pitch() / (2.0 * std::f64::consts::PI.sqrt())).sqrt().min(1.0);
        self.rank = [
            bx.rank(LOSS / (amplitude * norm(by))),
            by.rank(LOSS / (amplitude * norm(bx))),
        ];
        let significance = amplitude * norm(bx) * norm(by);
        self.smear = frame
            .smear
            .as_ref()
            .filter(|smear| significance * smear.change_of_shape() > NOTICEABLE)
            .map(|smear| smear.to_within(SMEAR_LOSS / brightest));
        let unevenness = self.smear.as_ref().map_or(0.0, DisplacedSpots::unevenness);
        self.unevenness = if significance * unevenness > NOTICEABLE {
            unevenness
        } else {
            0.0
        };
        self.mx = self.rank[0].next_multiple_of(4).min(bx.stride);
        self.my = self.rank[1].next_multiple_of(4).min(by.stride);
        // Columns up to the multiple of 4 are stored anyway: use them.
        self.rank = [self.mx.min(bx.columns()), self.my.min(by.columns())];
        let (mx, my) = (self.mx, self.my);
        self.weights.clear();
        self.position_weights.clear();
        self.log_det = 0.0;
        if bx.is_pixels && by.is_pixels {
            self.coefficients.clear();
            self.coefficients.resize(my * mx, 0.0);
            for (out, row) in self
                .coefficients
                .chunks_exact_mut(mx)
                .zip(frame.pixels.chunks_exact(nx))
            {
                out[..nx].copy_from_slice(row);
            }
        } else {
            self.compress(frame, bx, by);
        }
        let bad = frame.flagged.iter().map(|b| MaskedPixel {
            x: b.x,
            y: b.y,
            value: frame.pixels[b.y * nx + b.x],
        });
        self.masked.load(bad, &mut self.coefficients, mx, bx, by);
        self.update_weighted([bx, by]);
        let usable = (nx * ny - self.masked.len()) as f64;
        self.data_count = ((self.rank[0] * self.rank[1]) as f64).min(usable);
        let left = usable - self.data_count;
        let filled = |b: &MaskedPixel| b.value.powi(2) - frame.pixels[b.y * nx + b.x].powi(2);
        let energy =
            square(&frame.pixels) + self.masked.pixels.iter().map(filled).sum::<f64>() - square(&self.coefficients);
        self.outside = (energy.max(0.0) / left.max(1.0), left);
        (self.variance, self.mean_variance, self.light_weighted_variance) = (VarianceFunction::default(), 1.0, 1.0);
        if self.is_weighted {
            self.set_weights(frame, [bx, by], |_| 1.0);
        }
    }

    #[inline(always)]
    fn compress(&mut self, frame: &PreprocessedFrame, bx: &Basis, by: &Basis) {
        let (mx, my) = (self.mx, self.my);
        self.rows.resize(by.n * mx, 0.0);
        for (out, row) in self.rows.chunks_exact_mut(mx).zip(frame.pixels.chunks_exact(bx.n)) {
            combine([row], 1, bx.rows(), bx.stride, mx, out);
        }
        self.coefficients.resize(my * mx, 0.0);
        for (c, out) in self.coefficients.chunks_exact_mut(4 * mx).enumerate() {
            let columns = [0, 1, 2, 3].map(|k| &by.rows()[4 * c + k..]);
            combine(columns, by.stride, &self.rows, mx, mx, out);
        }
    }

    /// Gives every pixel the weight 1/`variance`, (Ny, Nx), and masked ones 0. Only in the pixel bases.
    pub fn set_weights(&mut self, frame: &PreprocessedFrame, axes: [&Basis; 2], variance: impl Fn(usize) -> f64) {
        let nx = axes[0].n;
        self.weights.clear();
        self.weights.resize(self.coefficients.len(), 0.0);
        self.log_det = 0.0;
        for (y, row) in frame.is_masked.chunks_exact(nx).enumerate() {
            for first in (0..nx).step_by(AT_ONCE) {
                let mut product = 1.0;
                for x in (first..nx.min(first + AT_ONCE)).filter(|x| !row[*x]) {
                    let v = variance(y * nx + x);
                    product *= v;
                    self.weights[y * self.mx + x] = 1.0 / v;
                }
                self.log_det += f64::ln(product);
            }
        }
        self.masked.clear();
        self.update_weighted(axes);
    }

    /// Whether the weights allow for an inexact PSF.
    pub fn has_spot_error(&self) -> bool {
        !self.position_weights.is_empty()
    }

    /// Updates the weighted coefficients after a change of coefficients, weights or masked pixels.
    #[inline(always)]
    pub fn update_weighted(&mut self, axes: [&Basis; 2]) {
        if self.is_unweighted() {
            return;
        }
        let mut weighted = std::mem::take(&mut self.weighted);
        weighted.clone_from(&self.coefficients);
        self.apply_weights(&mut weighted, axes, true, &mut Vec::new());
        self.weighted = weighted;
    }

    /// Whether all data have the same weight.
    pub fn is_unweighted(&self) -> bool {
        self.weights.is_empty() && self.masked.is_empty()
    }

    /// Applies the weights to a matrix (my, mx): the pixels' inverse variances, or the removal of masked pixels. `is_residual`: the matrix
    /// is the frame less a prediction. Returns the weighted square.
    #[inline(always)]
    pub fn apply_weights(
        &self,
        matrix: &mut [f64],
        axes: [&Basis; 2],
        is_residual: bool,
        scratch: &mut Vec<f64>,
    ) -> f64 {
        if self.weights.is_empty() {
            let whole = dot(matrix, matrix);
            if self.masked.is_empty() {
                return whole;
            }
            return whole - self.masked.project_out(matrix, self.mx, axes, is_residual, scratch);
        }
        let mut square = 0.0;
        for (m, w) in matrix.iter_mut().zip(&self.weights) {
            let weighted = w * *m;
            square += weighted * *m;
            *m = weighted;
        }
        square
    }

    /// The coefficients times their weights.
    #[inline(always)]
    pub fn weighted_coefficients(&self) -> &[f64] {
        if self.is_unweighted() {
            &self.coefficients
        } else {
            &self.weighted
        }
    }

    /// Most sources of a hypothesis: each takes three of the data.
    pub fn max_sources(&self) -> usize {
        MAX_SOURCES.min((self.data_count / 3.0) as usize).max(1)
    }

    /// Whether the deviance of a hypothesis is that of noise alone.
    pub fn is_explained_by(&self, hypothesis: &Hypothesis) -> bool {
        self.excess(hypothesis) < self.most_excess()
    }

    /// Excess up to which noise alone explains the frame.
    pub fn most_excess(&self) -> f64 {
        MOST_EXCESS + self.spare_excess
    }

    /// Deviance beyond its expectation, in units of about its standard deviation.
    pub fn excess(&self, hypothesis: &Hypothesis) -> f64 {
        let freedom = (self.data_count - hypothesis.parameters() as f64).max(1.0);
        let spread = (2.0 * freedom).sqrt() + 1.0;
        (hypothesis.deviance - self.mean_variance * freedom) / (self.light_weighted_variance * spread)
    }

    /// Deviance over its expectation; 1 where the hypothesis explains the frame.
    pub fn misfit(&self, hypothesis: &Hypothesis) -> f64 {
        if self.is_explained_by(hypothesis) {
            return 1.0;
        }
        let freedom = (self.data_count - hypothesis.parameters() as f64).max(1.0);
        (hypothesis.deviance / (self.mean_variance * freedom)).max(1.0)
    }

    /// Fills `out` (Ny, Nx) with the part of the frame within the bases, Uᵧ Z Uₓᵀ.
    pub fn expand(&self, bx: &Basis, by: &Basis, out: &mut Vec<f64>) {
        self.expand_matrix(&self.coefficients, bx, by, out);
    }

    /// The same for any matrix (my, mx) of coefficients.
    pub fn expand_matrix(&self, matrix: &[f64], bx: &Basis, by: &Basis, out: &mut Vec<f64>) {
        dispatch!(<'a>
            compressed: &'a CompressedFrame = self,
            matrix: &'a [f64] = matrix,
            bx: &'a Basis = bx,
            by: &'a Basis = by,
            out: &'a mut Vec<f64> = out
            => (): compressed.expand_rows(matrix, bx, by, out));
    }

    #[inline(always)]
    fn expand_rows(&self, matrix: &[f64], bx: &Basis, by: &Basis, out: &mut Vec<f64>) {
        let (mx, my) = (self.mx, self.my);
        out.clear();
        out.resize(bx.n * by.n, 0.0);
        if bx.is_pixels && by.is_pixels {
            for (out, row) in out.chunks_exact_mut(bx.n).zip(matrix.chunks_exact(mx)) {
                out.copy_from_slice(&row[..bx.n]);
            }
            return;
        }
        let mut row = vec![0.0; mx];
        for (y, out) in out.chunks_exact_mut(bx.n).enumerate() {
            combine([&by.row(y)[..my]], 1, matrix, mx, mx, &mut row);
            for (x, o) in out.iter_mut().enumerate() {
                *o = dot(&row, &bx.row(x)[..mx]);
            }
        }
    }
}

#[inline(always)]
fn square(v: &[f64]) -> f64 {
    dot(v, v)
}
