//! A frame in the two bases, ready to be fitted.

use crate::estimate::dense_linalg::{combine, dot, largest};
use crate::estimate::model::hypothesis::Model;
use crate::estimate::model::psf_table;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::masked_pixels::{BadPixel, Unusable};
use crate::estimate::preprocess::noise_variance::Growth;
use crate::estimate::preprocess::screening::Screened;

/// What a frame may leave outside the basis, in units of the noise.
const LOSS: f64 = 0.02;
/// Emitters a frame may hold at most.
const MOST_SPOTS: usize = 80;

/// Coefficients of a screened frame and what the rest of it says about the noise.
#[derive(Clone, Default)]
pub(crate) struct Reading {
    /// Columns in use along each axis, and their next multiples of 4.
    pub rank: [usize; 2],
    pub mx: usize,
    pub my: usize,
    /// (my, mx) row-major.
    pub z: Vec<f64>,
    pub bad: Unusable,
    /// Inverse variances (my, mx) where pixels differ in them, and Σ ln of the variances. Only in the pixel bases.
    pub weights: Vec<f64>,
    pub log_det: f64,
    weighted: Vec<f64>,
    /// A spot farther out than this many of its widths is lost in the noise.
    pub reach: f64,
    /// Numbers that the fit explains: coefficients, or usable pixels where those are fewer.
    pub numbers: f64,
    /// Mean square of what lies outside the basis, and how many numbers that is.
    pub outside: (f64, f64),
    /// How the noise grows with the signal, its mean variance over the frame and over its light.
    pub growth: Growth,
    pub mean_variance: f64,
    pub lit_variance: f64,
    rows: Vec<f64>,
}

impl Reading {
    /// Compresses `frame`, Z = Uᵧᵀ Y Uₓ.
    pub fn load(&mut self, frame: &Screened, bx: &Basis, by: &Basis) {
        pulp::Arch::new().dispatch(Load {
            reading: self,
            frame,
            bx,
            by,
        });
    }

    #[inline(always)]
    fn read(&mut self, frame: &Screened, bx: &Basis, by: &Basis) {
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
        self.mx = self.rank[0].next_multiple_of(4).min(bx.stride);
        self.my = self.rank[1].next_multiple_of(4).min(by.stride);
        // Columns up to the multiple of 4 are there anyway: use them.
        self.rank = [self.mx.min(bx.columns()), self.my.min(by.columns())];
        let (mx, my) = (self.mx, self.my);
        self.weights.clear();
        self.log_det = 0.0;
        if bx.is_pixels && by.is_pixels {
            self.z.clear();
            self.z.resize(my * mx, 0.0);
            for (out, row) in self.z.chunks_exact_mut(mx).zip(frame.pixels.chunks_exact(nx)) {
                out[..nx].copy_from_slice(row);
            }
        } else {
            self.compress(frame, bx, by);
        }
        let bad = frame.bad.iter().map(|b| BadPixel {
            x: b.x,
            y: b.y,
            value: frame.pixels[b.y * nx + b.x],
        });
        self.bad.load(bad, &mut self.z, mx, bx, by);
        self.reweight([bx, by]);
        let usable = (nx * ny - self.bad.len()) as f64;
        self.numbers = ((self.rank[0] * self.rank[1]) as f64).min(usable);
        let left = usable - self.numbers;
        let filled = |b: &BadPixel| b.value.powi(2) - frame.pixels[b.y * nx + b.x].powi(2);
        let energy = square(&frame.pixels) + self.bad.pixels.iter().map(filled).sum::<f64>() - square(&self.z);
        self.outside = (energy.max(0.0) / left.max(1.0), left);
        (self.growth, self.mean_variance, self.lit_variance) = (Growth::default(), 1.0, 1.0);
    }

    #[inline(always)]
    fn compress(&mut self, frame: &Screened, bx: &Basis, by: &Basis) {
        let (mx, my) = (self.mx, self.my);
        self.rows.resize(by.n * mx, 0.0);
        for (out, row) in self.rows.chunks_exact_mut(mx).zip(frame.pixels.chunks_exact(bx.n)) {
            combine([row], 1, bx.rows(), bx.stride, mx, out);
        }
        self.z.resize(my * mx, 0.0);
        for (c, out) in self.z.chunks_exact_mut(4 * mx).enumerate() {
            let columns = [0, 1, 2, 3].map(|k| &by.rows()[4 * c + k..]);
            combine(columns, by.stride, &self.rows, mx, mx, out);
        }
    }

    /// Gives every pixel the weight 1/`variance`, (Ny, Nx), and unusable ones none.
    pub fn weigh(&mut self, frame: &Screened, axes: [&Basis; 2], variance: impl Fn(usize) -> f64) {
        let nx = axes[0].n;
        self.weights.clear();
        self.weights.resize(self.z.len(), 0.0);
        self.log_det = 0.0;
        for (k, _) in frame.is_bad.iter().enumerate().filter(|(_, bad)| !**bad) {
            let v = variance(k);
            self.log_det += v.ln();
            self.weights[k / nx * self.mx + k % nx] = 1.0 / v;
        }
        self.bad.clear();
        self.reweight(axes);
    }

    /// Weights the frame anew.
    #[inline(always)]
    pub fn reweight(&mut self, axes: [&Basis; 2]) {
        if self.is_even() {
            return;
        }
        let mut weighted = std::mem::take(&mut self.weighted);
        weighted.clone_from(&self.z);
        self.weight(&mut weighted, axes, true, &mut Vec::new());
        self.weighted = weighted;
    }

    /// Whether all numbers count alike.
    pub fn is_even(&self) -> bool {
        self.weights.is_empty() && self.bad.is_empty()
    }

    /// Weights a matrix (my, mx): by the pixels' inverse variances, or none for those that tell nothing; `is_residual` where it is
    /// the frame less a model. Returns its weighted square.
    #[inline(always)]
    pub fn weight(&self, matrix: &mut [f64], axes: [&Basis; 2], is_residual: bool, scratch: &mut Vec<f64>) -> f64 {
        if self.weights.is_empty() {
            let whole = dot(matrix, matrix);
            if self.bad.is_empty() {
                return whole;
            }
            return whole - self.bad.take_out(matrix, self.mx, axes, is_residual, scratch);
        }
        let mut square = 0.0;
        for (m, w) in matrix.iter_mut().zip(&self.weights) {
            let weighted = w * *m;
            square += weighted * *m;
            *m = weighted;
        }
        square
    }

    /// The frame times its weights.
    #[inline(always)]
    pub fn weighted(&self) -> &[f64] {
        if self.is_even() { &self.z } else { &self.weighted }
    }

    /// Emitters that are looked for at most: three numbers each must be had from the frame.
    pub fn most_spots(&self) -> usize {
        MOST_SPOTS.min((self.numbers / 3.0) as usize).max(1)
    }

    /// Whether the model explains the frame to within the noise.
    pub fn is_explained(&self, model: &Model) -> bool {
        let freedom = (self.numbers - model.parameters() as f64).max(1.0);
        let spread = 2.5 * (2.0 * freedom).sqrt() + 2.5;
        model.deviance < self.mean_variance * freedom + self.lit_variance * spread
    }

    /// How many times the expected deviance a model leaves; 1 where it explains the frame.
    pub fn misfit(&self, model: &Model) -> f64 {
        if self.is_explained(model) {
            return 1.0;
        }
        let freedom = (self.numbers - model.parameters() as f64).max(1.0);
        (model.deviance / (self.mean_variance * freedom)).max(1.0)
    }

    /// Fills `out` (Ny, Nx) with what the basis holds of the frame, Uᵧ Z Uₓᵀ.
    pub fn expand(&self, bx: &Basis, by: &Basis, out: &mut Vec<f64>) {
        self.expand_matrix(&self.z, bx, by, out);
    }

    /// The same for any matrix (my, mx) of coefficients.
    pub fn expand_matrix(&self, matrix: &[f64], bx: &Basis, by: &Basis, out: &mut Vec<f64>) {
        pulp::Arch::new().dispatch(Expand {
            reading: self,
            matrix,
            bx,
            by,
            out,
        });
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

struct Load<'a> {
    reading: &'a mut Reading,
    frame: &'a Screened,
    bx: &'a Basis,
    by: &'a Basis,
}

impl pulp::NullaryFnOnce for Load<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.reading.read(self.frame, self.bx, self.by);
    }
}

struct Expand<'a> {
    reading: &'a Reading,
    matrix: &'a [f64],
    bx: &'a Basis,
    by: &'a Basis,
    out: &'a mut Vec<f64>,
}

impl pulp::NullaryFnOnce for Expand<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.reading.expand_rows(self.matrix, self.bx, self.by, self.out);
    }
}

#[inline(always)]
fn square(v: &[f64]) -> f64 {
    dot(v, v)
}
