//! Measures the noise and finds hot and dead pixels from the part of a frame outside the basis, where no spot can reach.
//!
//! The mean square out there is the noise's variance, a single pixel that exceeds it is hot or dead, and where it grows with the
//! signal the noise is shot noise or gain scatter.

use crate::estimate::dense_linalg::largest;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::screening::PreprocessedFrame;

/// Fewest numbers outside the basis from which the noise is measured: with them its standard deviation is known to 7 %.
const FEWEST: f64 = 100.0;
/// Standard deviations by which the measured noise must differ from the configured noise to replace it: one frame in 16,000 by chance.
const DIFFERENT: f64 = 4.0;
/// Least measured noise, in units of the brightest pixel, where it is below the configured noise: fits converge up to this ratio.
const LEAST_NOISE: f64 = 1e-5;
/// Standard deviations from which a single pixel is hot or dead: one pixel in 5·10⁸ by chance.
const OUTLIER: f64 = 6.0;
/// Passes of rejection; each reloads the frame without the pixels found. With [`SHARE`] they reach from 2¹⁴ times the threshold down to it.
const PASSES: usize = 14;
/// One pass rejects pixels of at least this share of the worst one's deviation: the worst hide the rest.
const SHARE: f64 = 0.5;
/// Pixels wider than the first, σ, can be lit alone by a spot's misfit, which is less than its light, and wider than the second by a spot; these
/// are not tested for isolation.
const WIDEST_PIXEL: [f64; 2] = [0.5, 0.8];
/// The quantile of nine tenths of a χ² variate of one degree of freedom, and the standard deviations and rounds of a variance without outliers.
const NINE_TENTHS: f64 = 2.706;
const CLIPPED: f64 = 5.0;
const CLIPPINGS: usize = 4;
/// Signal levels at which the noise is measured: each holds half the pixels of the one before, the brightest 1/128.
const LEVELS: usize = 8;

/// The inspection's scratch memory and its last verdict.
#[derive(Default)]
pub(crate) struct NoiseInspection {
    smooth: Vec<f64>,
    leverage: [Vec<f64>; 2],
    squares: Vec<(f64, f64)>,
    /// Whether the part outside the basis is white noise of the configured variance.
    pub is_white: bool,
}

/// Whether a spot may explain a hot pixel: too little of the frame is outside the basis to show single pixels, and their neighbours can.
pub(crate) fn may_hide_outliers(compressed: &CompressedFrame, [bx, by]: [&Basis; 2]) -> bool {
    compressed.outside.1 < FEWEST && bx.pitch().max(by.pitch()) <= WIDEST_PIXEL[1]
}

impl NoiseInspection {
    /// Masks hot and dead pixels, measures the noise, and reloads `compressed` where that changes it: the frame is divided by the
    /// measured noise, which is returned in units of the configured noise.
    pub fn run(
        &mut self,
        frame: &mut PreprocessedFrame,
        compressed: &mut CompressedFrame,
        bx: &Basis,
        by: &Basis,
    ) -> f64 {
        let z = |compressed: &CompressedFrame| (compressed.outside.0 - 1.0) * (compressed.outside.1 / 2.0).sqrt();
        self.is_white = z(compressed).abs() < DIFFERENT;
        if self.is_white || compressed.outside.1 < FEWEST {
            return 1.0;
        }
        for _ in 0..PASSES {
            compressed.expand(bx, by, &mut self.smooth);
            self.measure_out_of_basis(frame, compressed, bx, by);
            if !self.mask_outliers(frame, compressed, bx.n) {
                break;
            }
            compressed.load(frame, bx, by);
        }
        compressed.expand(bx, by, &mut self.smooth);
        self.measure_out_of_basis(frame, compressed, bx, by);
        let dark = self.estimate_variance(compressed);
        // Constant noise is measured by its mean square; one without outliers would assume it Gaussian.
        let floor = if compressed.variance.is_constant() {
            compressed.outside.0
        } else {
            dark
        };
        let floor = if (floor - 1.0).abs() * (compressed.outside.1 / 2.0).sqrt() < DIFFERENT {
            1.0
        } else {
            floor
        };
        // A frame without noise would otherwise be fitted to its rounding.
        let least = (LEAST_NOISE * largest(0.0, &frame.pixels)).min(1.0);
        let floor = floor.max(least * least);
        let scale = floor.sqrt();
        for p in &mut frame.pixels {
            *p /= scale;
        }
        let variance = compressed.variance;
        compressed.load(frame, bx, by);
        // Of (1 + a s + b s²)·floor with s in the old units.
        compressed.variance = VarianceFunction {
            floor: 1.0,
            linear: variance.linear * scale,
            square: variance.square * floor,
        };
        let (mut all, mut lit, mut weight) = (0.0, 0.0, 0.0);
        for &s in &self.smooth {
            let s = (s / scale).max(0.0);
            let v = compressed.variance.at(s);
            all += v;
            lit += v * s;
            weight += s;
        }
        compressed.mean_variance = all / self.smooth.len() as f64;
        compressed.light_weighted_variance = if weight > 0.0 { (lit / weight).max(1.0) } else { 1.0 };
        scale
    }

    /// Masks isolated pixels that deviate from the light expected by a first hypothesis, (my, mx), as neither a spot nor its misfit can.
    /// Returns whether there were any.
    pub fn mask_isolated_outliers(
        &mut self,
        frame: &mut PreprocessedFrame,
        compressed: &mut CompressedFrame,
        expected: Vec<f64>,
        bx: &Basis,
        by: &Basis,
    ) -> bool {
        let pitch = bx.pitch().max(by.pitch());
        let [wide, widest] = WIDEST_PIXEL;
        if pitch > widest {
            return false;
        }
        let (nx, ny) = (bx.n, by.n);
        compressed.expand_matrix(&expected, bx, by, &mut self.smooth);
        let left: Vec<f64> = frame.pixels.iter().zip(&self.smooth).map(|(p, m)| p - m).collect();
        let mut found = Vec::new();
        for y in 0..ny {
            for x in 0..nx {
                let k = y * nx + x;
                if frame.is_masked[k] {
                    continue;
                }
                let (mut sum, mut count, mut most) = (0.0, 0.0, 0.0f64);
                for (a, b) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                    if a < nx && b < ny && !frame.is_masked[b * nx + a] {
                        sum += left[b * nx + a];
                        count += 1.0;
                        most = most.max(left[b * nx + a].abs());
                    }
                }
                let beyond = (left[k] - if count > 0.0 { sum / count } else { 0.0 }).abs();
                let noise = compressed.variance.at(self.smooth[k]).sqrt();
                // The mean of four neighbours adds a quarter of their variance.
                let is_alone = beyond > 0.8 * left[k].abs() && left[k].abs() > 0.6 * beyond.max(most);
                let is_misfit = pitch > wide && left[k].abs() < self.smooth[k];
                if is_alone && !is_misfit && beyond > OUTLIER * noise * 1.12 {
                    found.push((x, y));
                }
            }
        }
        for &(x, y) in &found {
            frame.mask(x, y, nx);
            frame.pixels[y * nx + x] = self.smooth[y * nx + x];
        }
        if !found.is_empty() {
            let noise = (
                compressed.variance,
                compressed.mean_variance,
                compressed.light_weighted_variance,
            );
            compressed.load(frame, bx, by);
            (
                compressed.variance,
                compressed.mean_variance,
                compressed.light_weighted_variance,
            ) = noise;
        }
        !found.is_empty()
    }

    /// Sets `squares`: for each pixel the signal and the squared out-of-basis part over the pixel's out-of-basis share.
    fn measure_out_of_basis(
        &mut self,
        frame: &PreprocessedFrame,
        compressed: &CompressedFrame,
        bx: &Basis,
        by: &Basis,
    ) {
        let share = |b: &Basis, m: usize| (0..b.n).map(|k| b.row(k)[..m].iter().map(|u| u * u).sum()).collect();
        self.leverage = [share(bx, compressed.mx), share(by, compressed.my)];
        self.squares.clear();
        for (k, (&p, &s)) in frame.pixels.iter().zip(&self.smooth).enumerate() {
            let outside = (1.0 - self.leverage[0][k % bx.n] * self.leverage[1][k / bx.n]).max(1e-3);
            let square = if frame.is_masked[k] {
                f64::NAN
            } else {
                (p - s).powi(2) / outside
            };
            self.squares.push((s, square));
        }
    }

    /// Masks the pixels with the largest out-of-basis part. Returns whether there were any.
    fn mask_outliers(&mut self, frame: &mut PreprocessedFrame, compressed: &mut CompressedFrame, nx: usize) -> bool {
        let floor = self.estimate_variance(compressed);
        let ny = frame.pixels.len() / nx;
        let excess = |k: usize| {
            let (s, square) = self.squares[k];
            if square.is_nan() {
                0.0
            } else {
                square / (floor * compressed.variance.at(s))
            }
        };
        let worst = (0..self.squares.len()).map(excess).fold(0.0, f64::max);
        let threshold = (OUTLIER * OUTLIER).max(SHARE * SHARE * worst);
        let mut found = Vec::new();
        for y in 0..ny {
            for x in 0..nx {
                let value = excess(y * nx + x);
                if value <= threshold {
                    continue;
                }
                let near_y = y.saturating_sub(1)..=(y + 1).min(ny - 1);
                let is_largest = near_y
                    .flat_map(|b| (x.saturating_sub(1)..=(x + 1).min(nx - 1)).map(move |a| b * nx + a))
                    .all(|k| excess(k) <= value);
                if is_largest {
                    found.push((x, y));
                }
            }
        }
        for &(x, y) in &found {
            frame.mask(x, y, nx);
        }
        !found.is_empty()
    }

    /// Returns the variance in the dark and sets `compressed.variance`.
    fn estimate_variance(&mut self, compressed: &mut CompressedFrame) -> f64 {
        let mut points: Vec<(f64, f64)> = self.squares.iter().copied().filter(|s| !s.1.is_nan()).collect();
        if points.len() < 8 * LEVELS {
            return 1.0;
        }
        // The darkest half of the pixels is the dark level; the other levels rise in signal and fall in size.
        let mut levels = Vec::with_capacity(LEVELS);
        let mut rest = points.as_mut_slice();
        for _ in 0..LEVELS {
            let is_last = levels.len() + 1 == LEVELS;
            let size = if is_last { rest.len() } else { rest.len() / 2 };
            if size < 30 {
                break;
            }
            if !is_last {
                rest.select_nth_unstable_by(size, |a, b| a.0.total_cmp(&b.0));
            }
            let (part, brighter) = rest.split_at_mut(size);
            let signal = part.iter().map(|p| p.0.max(0.0)).sum::<f64>() / size as f64;
            levels.push((signal, clipped_variance(part), size as f64));
            rest = brighter;
        }
        let dark = levels.first().map_or(1.0, |l| l.1).max(1e-6);
        // Is the brightest level noisier than the darkest? The relative error is 1.4/√size, and more where the model misses spots.
        let brightest = levels
            .iter()
            .copied()
            .fold((0.0, 0.0, 1.0), |a, b| if b.1 > a.1 { b } else { a });
        let excess = brightest.1 / dark - 1.0;
        compressed.variance = VarianceFunction::default();
        if brightest.0 <= 0.0 || excess < DIFFERENT * 2.3 / (brightest.2).sqrt() {
            // One level: use all pixels together.
            return clipped_variance(&mut points).max(1e-6);
        }
        let fit = |power: i32| {
            let (mut top, mut bottom) = (0.0, 0.0);
            for &(s, v, size) in &levels {
                let (x, w) = (s.powi(power), size / (v / dark).powi(2));
                top += w * x * (v / dark - 1.0);
                bottom += w * x * x;
            }
            let slope = (top / bottom).max(0.0);
            let misfit: f64 = levels
                .iter()
                .map(|&(s, v, size)| size * (v / dark / (1.0 + slope * s.powi(power)) - 1.0).powi(2))
                .sum();
            (slope, misfit)
        };
        let ((linear, a), (square, b)) = (fit(1), fit(2));
        compressed.variance = if a < b {
            VarianceFunction {
                linear,
                ..VarianceFunction::default()
            }
        } else {
            VarianceFunction {
                square,
                ..VarianceFunction::default()
            }
        };
        dark
    }
}

/// Variance by the mean of the squares within [`CLIPPED`] standard deviations of a first one, which is by the quantile of nine tenths: outliers
/// hardly change it, and whole counts as coarse as the noise do not either, of which a median is one or the next. The points,
/// (signal, square), come back in another order.
fn clipped_variance(points: &mut [(f64, f64)]) -> f64 {
    let most = points.len() * 9 / 10;
    let mut variance = points.select_nth_unstable_by(most, |a, b| a.1.total_cmp(&b.1)).1.1 / NINE_TENTHS;
    for _ in 0..CLIPPINGS {
        let (mut sum, mut count) = (0.0, 0.0);
        for (_, square) in points
            .iter()
            .filter(|(_, square)| *square <= CLIPPED * CLIPPED * variance)
        {
            sum += square;
            count += 1.0;
        }
        variance = sum / f64::max(count, 1.0);
    }
    variance
}
