//! What a frame itself says about its noise, without a model of its emitters.
//!
//! No spot can reach outside the basis, so what lies there is noise: its mean square is the noise's, a single pixel
//! that stands out of it is hot or dead, and where it grows with the signal the noise is shot noise or gain scatter.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::noise_variance::Growth;
use crate::estimate::preprocess::screening::Screened;

/// Numbers outside the basis below which they are too few to judge by.
const FEWEST: f64 = 100.0;
/// Standard deviations by which the noise must differ from the configured before it is believed.
const DIFFERENT: f64 = 4.0;
/// Standard deviations at which a single pixel is taken for hot or dead.
const OUTLIER: f64 = 6.0;
const PASSES: usize = 14;
/// One pass rejects what stands out at least this share of the worst: the worst hide the rest.
const SHARE: f64 = 0.5;
/// Pixels wider than this, σ, can be lit alone by a spot.
const WIDEST_PIXEL: f64 = 0.5;
/// Signal levels that the noise is measured at.
const LEVELS: usize = 8;

/// Scratch memory of the inspection.
#[derive(Default)]
pub(crate) struct Inspection {
    smooth: Vec<f64>,
    leverage: [Vec<f64>; 2],
    squares: Vec<(f64, f64)>,
    /// Nothing but noise lies outside the basis.
    pub is_clean: bool,
}

impl Inspection {
    /// Finds hot and dead pixels, measures the noise, and loads `reading` anew where that changes it: the frame is
    /// divided by the noise measured (returned, in units of the configured), bad pixels are listed and filled in.
    pub fn run(&mut self, frame: &mut Screened, reading: &mut Reading, bx: &Basis, by: &Basis) -> f64 {
        let z = |reading: &Reading| (reading.outside.0 - 1.0) * (reading.outside.1 / 2.0).sqrt();
        self.is_clean = z(reading).abs() < DIFFERENT;
        if self.is_clean || reading.outside.1 < FEWEST {
            return 1.0;
        }
        for _ in 0..PASSES {
            reading.expand(bx, by, &mut self.smooth);
            self.measure(frame, reading, bx, by);
            if !self.reject(frame, reading, bx.n) {
                break;
            }
            reading.load(frame, bx, by);
        }
        reading.expand(bx, by, &mut self.smooth);
        self.measure(frame, reading, bx, by);
        let dark = self.grow(reading);
        // Even noise is best measured by all of it; a median would take it for Gaussian.
        let floor = if reading.growth.is_flat() {
            reading.outside.0
        } else {
            dark
        };
        let floor = if (floor - 1.0).abs() * (reading.outside.1 / 2.0).sqrt() < DIFFERENT {
            1.0
        } else {
            floor
        };
        let scale = floor.sqrt();
        for p in &mut frame.pixels {
            *p /= scale;
        }
        let growth = reading.growth;
        reading.load(frame, bx, by);
        // Of (1 + a s + b s²)·floor with s in the old units.
        reading.growth = Growth {
            floor: 1.0,
            linear: growth.linear * scale,
            square: growth.square * floor,
        };
        let (mut all, mut lit, mut weight) = (0.0, 0.0, 0.0);
        for &s in &self.smooth {
            let s = (s / scale).max(0.0);
            let v = reading.growth.at(s);
            all += v;
            lit += v * s;
            weight += s;
        }
        reading.mean_variance = all / self.smooth.len() as f64;
        reading.lit_variance = if weight > 0.0 { (lit / weight).max(1.0) } else { 1.0 };
        scale
    }

    /// Rejects pixels that stand out of what a first model expects, (my, mx), alone, as no spot or misfit of one can.
    /// `true` where there were any.
    pub fn reject_lone(
        &mut self,
        frame: &mut Screened,
        reading: &mut Reading,
        expected: Vec<f64>,
        bx: &Basis,
        by: &Basis,
    ) -> bool {
        if bx.pitch().max(by.pitch()) > WIDEST_PIXEL {
            return false;
        }
        let (nx, ny) = (bx.n, by.n);
        reading.expand_matrix(&expected, bx, by, &mut self.smooth);
        let left: Vec<f64> = frame.pixels.iter().zip(&self.smooth).map(|(p, m)| p - m).collect();
        let mut found = Vec::new();
        for y in 0..ny {
            for x in 0..nx {
                let k = y * nx + x;
                if frame.is_bad[k] {
                    continue;
                }
                let (mut sum, mut count, mut most) = (0.0, 0.0, 0.0f64);
                for (a, b) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                    if a < nx && b < ny && !frame.is_bad[b * nx + a] {
                        sum += left[b * nx + a];
                        count += 1.0;
                        most = most.max(left[b * nx + a].abs());
                    }
                }
                let beyond = (left[k] - if count > 0.0 { sum / count } else { 0.0 }).abs();
                let noise = reading.growth.at(self.smooth[k]).sqrt();
                // The mean of four neighbours adds a quarter of their variance.
                let is_alone = beyond > 0.8 * left[k].abs() && left[k].abs() > 0.6 * beyond.max(most);
                if is_alone && beyond > OUTLIER * noise * 1.12 {
                    found.push((x, y));
                }
            }
        }
        for &(x, y) in &found {
            frame.reject(x, y, nx);
            frame.pixels[y * nx + x] = self.smooth[y * nx + x];
        }
        if !found.is_empty() {
            let noise = (reading.growth, reading.mean_variance, reading.lit_variance);
            reading.load(frame, bx, by);
            (reading.growth, reading.mean_variance, reading.lit_variance) = noise;
        }
        !found.is_empty()
    }

    /// Squares of what lies outside, each over the share of a pixel that does, with the signal there.
    fn measure(&mut self, frame: &Screened, reading: &Reading, bx: &Basis, by: &Basis) {
        let share = |b: &Basis, m: usize| (0..b.n).map(|k| b.row(k)[..m].iter().map(|u| u * u).sum()).collect();
        self.leverage = [share(bx, reading.mx), share(by, reading.my)];
        self.squares.clear();
        for (k, (&p, &s)) in frame.pixels.iter().zip(&self.smooth).enumerate() {
            let outside = (1.0 - self.leverage[0][k % bx.n] * self.leverage[1][k / bx.n]).max(1e-3);
            let square = if frame.is_bad[k] {
                f64::NAN
            } else {
                (p - s).powi(2) / outside
            };
            self.squares.push((s, square));
        }
    }

    /// Rejects pixels that stand out. `false` where there was none.
    fn reject(&mut self, frame: &mut Screened, reading: &mut Reading, nx: usize) -> bool {
        let floor = self.grow(reading);
        let ny = frame.pixels.len() / nx;
        let excess = |k: usize| {
            let (s, square) = self.squares[k];
            if square.is_nan() {
                0.0
            } else {
                square / (floor * reading.growth.at(s))
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
            frame.reject(x, y, nx);
        }
        !found.is_empty()
    }

    /// Variance in the dark, with its growth with the signal set in `reading`. Medians, so that outliers count for
    /// little: the median of a χ² variate of one degree of freedom is 0.4549.
    fn grow(&mut self, reading: &mut Reading) -> f64 {
        let mut points: Vec<(f64, f64)> = self.squares.iter().copied().filter(|s| !s.1.is_nan()).collect();
        if points.len() < 8 * LEVELS {
            return 1.0;
        }
        // Half the pixels make the dark level, the rest levels of rising signal and falling number.
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
            levels.push((signal, median_variance(part), size as f64));
            rest = brighter;
        }
        let dark = levels.first().map_or(1.0, |l| l.1).max(1e-6);
        // Is the brightest level noisier than the darkest? The median's relative error is about 2.3/√size.
        let brightest = levels
            .iter()
            .copied()
            .fold((0.0, 0.0, 1.0), |a, b| if b.1 > a.1 { b } else { a });
        let excess = brightest.1 / dark - 1.0;
        reading.growth = Growth::default();
        if brightest.0 <= 0.0 || excess < DIFFERENT * 2.3 / (brightest.2).sqrt() {
            // One level: all pixels together say it best.
            return median_variance(&mut points).max(1e-6);
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
        reading.growth = if a < b {
            Growth {
                linear,
                ..Growth::default()
            }
        } else {
            Growth {
                square,
                ..Growth::default()
            }
        };
        dark
    }
}

/// Variance by the median of squares; the points, (signal, square), come back in another order.
fn median_variance(points: &mut [(f64, f64)]) -> f64 {
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| a.1.total_cmp(&b.1)).1.1 / 0.4549
}
