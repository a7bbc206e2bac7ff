//! Pixels whose light is no spot's: hot ones, ones that flicker, and those of a line that is off.

use ndarray::{Array2, s};

use crate::optics::{Axis, Camera, add_spot};
use crate::stats::median;

/// Frames over which light is summed. More find fainter pixels, fewer forget sooner what has passed. Not tuned.
const FRAMES: f64 = 32.0;
/// Least decrease of the deviance by a pixel's light, and below which one that was odd no longer is. Noise exceeds the first in no pixel of a
/// million frames.
const LEAST: f64 = 45.0;
const STAYS: f64 = 12.0;
/// How much more of the deviance a pixel or a line explains than a spot there: what noise adds to one of the two.
const MARGIN: f64 = 12.0;
/// How much brighter than its diagonal neighbours a pixel is that may be odd: saves the comparison with spots.
const ABOVE_NEIGHBOURS: f64 = 2.0;
/// How much more a spot on a pixel's middle is than its light there, for spots and pixels to be told apart.
const LEAST_SPREAD: f64 = 1.5;
/// Median size of the pixels' light over that of noise from which on all of them are odd. Lower takes noise that is larger than configured for
/// a pattern.
const PATTERNED: f64 = 1.35;
/// The median of |z|, z standard normal.
const MEDIAN_OF_NOISE: f64 = 0.6745;
/// Half the size of the comparison, σ.
const REACH: f64 = 2.0;
/// Share of what emitters explain of a pixel's light that may be missing where their spots are not quite as wide as they are taken to be.
const MISFIT: f64 = 0.1;

/// The light of each pixel, summed over frames, older ones fading.
pub(crate) struct OddPixels {
    /// In standard deviations of one frame's noise.
    light: Array2<f64>,
    /// What emitters explain of it.
    explained: Array2<f64>,
    /// All light of those found on a pixel or beside it: they may be its own.
    beside: Array2<f64>,
    frames: f64,
    /// Variance of that sum where it is noise.
    variance: f64,
    is_odd: Array2<bool>,
    count: usize,
    /// Shares of a spot on a pixel's middle, which is the middle one.
    spot: Array2<f64>,
}

impl OddPixels {
    pub fn new(camera: &Camera) -> Self {
        Self {
            light: Array2::zeros(camera.shape()),
            explained: Array2::zeros(camera.shape()),
            beside: Array2::zeros(camera.shape()),
            frames: 0.0,
            variance: 0.0,
            is_odd: Array2::default(camera.shape()),
            count: 0,
            spot: spot_shares(camera),
        }
    }

    pub fn pixels(&self) -> &Array2<bool> {
        &self.is_odd
    }

    pub fn are_any(&self) -> bool {
        self.count > 0
    }

    /// Whether most dark pixels have a light of their own: to many frames together such a pattern is emitters, and no surface describes it.
    pub fn are_all(&self, is_lit: &Array2<bool>) -> bool {
        let rest = self.light.iter().zip(&self.explained).zip(is_lit);
        let dark = rest.filter(|(_, lit)| !**lit);
        let middle = median(dark.map(|((light, explained), _)| (light - explained).abs()).collect());
        middle.is_some_and(|middle| middle > PATTERNED * MEDIAN_OF_NOISE * self.variance.sqrt())
    }

    /// These and the frame's own masked pixels.
    pub fn with(&self, masked: Option<&Array2<bool>>) -> Option<Array2<bool>> {
        match masked {
            Some(masked) if self.are_any() => Some(masked | &self.is_odd),
            None if self.are_any() => Some(self.is_odd.clone()),
            _ => masked.cloned(),
        }
    }

    /// Learns from a frame's pixels (ny, nx), NaN where they are not usable, from what the emitters found in it explain of them, both in standard
    /// deviations of the noise, and from where these are, m, and their whole light.
    pub fn learn(
        &mut self,
        values: &Array2<f64>,
        explained: &Array2<f64>,
        axes: [&Axis; 2],
        spots: impl Iterator<Item = ([f64; 2], f64)>,
    ) {
        let keep = 1.0 - 1.0 / FRAMES;
        self.frames = keep * self.frames + 1.0;
        self.variance = keep * keep * self.variance + 1.0;
        let sums = self.light.iter_mut().zip(&mut self.explained);
        for ((light, sum), (value, explained)) in sums.zip(values.iter().zip(explained)) {
            let is_used = !value.is_nan();
            *light = keep * *light + if is_used { *value } else { 0.0 };
            *sum = keep * *sum + if is_used { *explained } else { 0.0 };
        }
        self.beside *= keep;
        spots.for_each(|(at, light)| self.note_beside(axes, at, light));
        let [least, stays] = [LEAST, STAYS].map(|share| share * self.frames);
        for at in self.asked(least) {
            let was_odd = self.is_odd[at];
            let is_odd = match was_odd {
                true => self.rest(at).powi(2) > stays,
                false => self.is_no_spot(at),
            };
            self.is_odd[at] = is_odd;
            self.count += usize::from(is_odd);
            self.count -= usize::from(was_odd);
        }
    }

    fn note_beside(&mut self, axes: [&Axis; 2], at: [f64; 2], light: f64) {
        let [columns, rows] = [0, 1].map(|k| {
            let at = (at[k] - axes[k].min_m) / axes[k].pitch_m;
            ((at - 1.5).ceil().max(0.0) as usize)..((at + 0.5).ceil().clamp(0.0, axes[k].n as f64) as usize)
        });
        for row in rows {
            columns.clone().for_each(|column| self.beside[(row, column)] += light);
        }
    }

    /// Share of a spot in the pixel on whose middle it is.
    fn peak(&self) -> f64 {
        self.spot[(self.spot.nrows() / 2, self.spot.ncols() / 2)]
    }

    /// A pixel's light that no emitter explains.
    fn rest(&self, at: (usize, usize)) -> f64 {
        self.light[at] - self.explained[at]
    }

    /// Odd pixels, and those of more light than noise has that are brighter than their diagonal neighbours.
    fn asked(&self, least: f64) -> Vec<(usize, usize)> {
        let (ny, nx) = self.light.dim();
        let peak = self.peak();
        let mut asked = Vec::new();
        for y in 0..ny {
            let [above, below] = [y.saturating_sub(1), (y + 1).min(ny - 1)];
            for x in 0..nx {
                let [left, right] = [x.saturating_sub(1), (x + 1).min(nx - 1)];
                let diagonal = || -> f64 {
                    let corners = [(above, left), (above, right), (below, left), (below, right)];
                    corners.iter().map(|at| self.rest(*at)).sum()
                };
                let light = self.rest((y, x)) + self.beside[(y, x)] * peak;
                let is_above = || 4.0 * light.abs() > ABOVE_NEIGHBOURS * diagonal().abs();
                if self.is_odd[(y, x)] || light * light > least && is_above() {
                    asked.push((y, x));
                }
            }
        }
        asked
    }

    /// Whether a pixel's own light, or what its row or column has, explains more than a spot's there. The light of emitters beside it may be
    /// either; that of others is neither.
    fn is_no_spot(&self, at: (usize, usize)) -> bool {
        let (y, x) = at;
        let (ny, nx) = self.light.dim();
        let (half_y, half_x) = (self.spot.nrows() / 2, self.spot.ncols() / 2);
        let (mut fits, mut norm) = (0.0, 0.0);
        for row in y.saturating_sub(half_y)..(y + half_y + 1).min(ny) {
            for column in x.saturating_sub(half_x)..(x + half_x + 1).min(nx) {
                let share = self.spot[(row + half_y - y, column + half_x - x)];
                fits += share * self.rest((row, column));
                norm += share * share;
            }
        }
        let (beside, peak) = (self.beside[at], self.peak());
        fits += beside * norm;
        let others = (self.explained[at] - beside * peak).max(0.0);
        let light = ((self.rest(at) + beside * peak).abs() - MISFIT * others).max(0.0);
        let row = light_of((0..nx).map(|x| self.rest((y, x))).collect());
        let column = light_of((0..ny).map(|y| self.rest((y, x))).collect());
        let own = light.powi(2).max(row).max(column);
        norm > LEAST_SPREAD * peak * peak && own > fits * fits / norm + MARGIN * self.frames
    }
}

/// A spot in the middle of the sensor, on a pixel's middle, out to [`REACH`].
fn spot_shares(camera: &Camera) -> Array2<f64> {
    let axes = [&camera.y, &camera.x];
    let middle = axes.map(|axis| axis.n / 2);
    let half = [0, 1].map(|k| {
        let reach = (REACH * camera.spot_sigma_m / axes[k].pitch_m).ceil().max(1.0) as usize;
        reach.min(middle[k]).min(axes[k].n - 1 - middle[k])
    });
    let mut all = Array2::zeros(camera.shape());
    let at = [camera.x.centre(middle[1]), camera.y.centre(middle[0])];
    add_spot(camera, at, 1.0, all.as_slice_mut().expect("row by row"));
    let [rows, columns] = [0, 1].map(|k| middle[k] - half[k]..middle[k] + half[k] + 1);
    all.slice(s![rows, columns]).to_owned()
}

/// The decrease of the deviance by what three quarters of a line's pixels have at least: spots on a line are not its own light.
fn light_of(mut line: Vec<f64>) -> f64 {
    line.sort_unstable_by(f64::total_cmp);
    let [low, high] = [line.len() / 4, line.len() - 1 - line.len() / 4].map(|k| line[k]);
    low.max(0.0).max(-high).powi(2) * line.len() as f64
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::optics::Config;
    use crate::optics::psf::pixel_fraction;

    const PIXELS: usize = 40;
    const AT: (usize, usize) = (20, 12);

    /// σ of a spot, pixels.
    const SIGMA: f64 = 0.8;

    fn camera() -> Camera {
        let config = Config {
            pixels: [PIXELS; 2],
            sensor_size_m: [0.03; 2],
            spot_sigma_m: Some(SIGMA * 0.03 / PIXELS as f64),
            ..Config::default()
        };
        config.camera().expect("a sound config")
    }

    /// The pixels that are odd after so many frames in which `light(frame, y, x)` is added to noise.
    fn odd(light: impl Fn(usize, usize, usize) -> f64, frames: usize) -> Vec<(usize, usize)> {
        odd_beside(&[], light, frames)
    }

    /// The same where spots are found at these places (y, x), pixels, with this peak.
    fn odd_beside(
        spots: &[([f64; 2], f64)],
        light: impl Fn(usize, usize, usize) -> f64,
        frames: usize,
    ) -> Vec<(usize, usize)> {
        let camera = camera();
        let mut odd = OddPixels::new(&camera);
        let place = |axis: &Axis, at: f64| axis.min_m + (at + 0.5) * axis.pitch_m;
        let whole = pixel_fraction(-0.5, 0.5, 0.0, SIGMA).powi(-2);
        let found = spots
            .iter()
            .map(|([y, x], peak)| ([place(&camera.x, *x), place(&camera.y, *y)], peak * whole));
        let explained = Array2::from_shape_fn((PIXELS, PIXELS), |(y, x)| {
            spots.iter().map(|(at, peak)| spot(y, x, *at, *peak)).sum::<f64>()
        });
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for k in 0..frames {
            let values = Array2::from_shape_fn((PIXELS, PIXELS), |(y, x)| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                noise + light(k, y, x)
            });
            odd.learn(&values, &explained, [&camera.x, &camera.y], found.clone());
        }
        let found = odd.pixels().indexed_iter().filter(|(_, odd)| **odd);
        found.map(|(at, _)| at).collect()
    }

    #[test]
    fn a_pattern_of_all_pixels_is_told_from_noise() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut noise = || -> f64 { StandardNormal.sample(&mut rng) };
        let shape = (PIXELS, PIXELS);
        let pattern = Array2::from_shape_simple_fn(shape, &mut noise);
        for (scatter, scale, expected) in [(0.0, 1.0, false), (0.0, 1.2, false), (0.2, 1.0, true)] {
            let mut odd = OddPixels::new(&camera());
            for _ in 0..100 {
                let values = Array2::from_shape_simple_fn(shape, &mut noise) * scale + &pattern * scatter;
                let camera = camera();
                odd.learn(
                    &values,
                    &Array2::zeros(shape),
                    [&camera.x, &camera.y],
                    std::iter::empty(),
                );
            }
            assert_eq!(odd.are_all(&Array2::default(shape)), expected, "{scatter} {scale}");
        }
    }

    fn spot(y: usize, x: usize, [at_y, at_x]: [f64; 2], peak: f64) -> f64 {
        let along = |k: usize, at: f64| pixel_fraction(k as f64 - 0.5, k as f64 + 0.5, at, SIGMA);
        peak * along(y, at_y) * along(x, at_x) / along(0, 0.0).powi(2)
    }

    #[test]
    fn what_is_beside_a_spot_is_told_from_it() {
        let (user, away) = (([20.2, 15.3], 3000.0), 3);
        let hot = (AT.0, 15 + away);
        let with = |light: f64| {
            move |_: usize, y: usize, x: usize| spot(y, x, user.0, user.1) + if (y, x) == hot { light } else { 0.0 }
        };
        assert_eq!(odd_beside(&[user], with(0.0), 100), []);
        assert_eq!(odd_beside(&[user], with(15.0), 5), [hot]);
        // The pixel was taken for an emitter.
        let taken = ([hot.0 as f64, hot.1 as f64], 12.0);
        assert_eq!(odd_beside(&[user, taken], with(15.0), 5), [hot]);
        // An emitter is there, and its user's spot is wider than it is taken to be.
        let two = |_: usize, y: usize, x: usize| 1.05 * spot(y, x, user.0, user.1) + spot(y, x, taken.0, 12.0);
        assert_eq!(odd_beside(&[user, taken], two, 100), []);
        assert_eq!(odd_beside(&[user], two, 100), []);
    }

    #[test]
    fn hot_pixels_and_those_of_a_line_are_odd_and_spots_are_not() {
        let is_there = |y: usize, x: usize| f64::from(u8::from((y, x) == AT));
        assert_eq!(odd(|_, _, _| 0.0, 200), []);
        assert_eq!(odd(|_, y, x| 10.0 * is_there(y, x), 1), [AT]);
        assert_eq!(odd(|_, y, x| 3.0 * is_there(y, x), 20), [AT]);
        // One that flickers stays odd, one that was hot long ago is not.
        assert_eq!(
            odd(|k, y, x| f64::from(k as u32 / 20 % 2) * 15.0 * is_there(y, x), 100),
            [AT]
        );
        assert_eq!(odd(|k, y, x| if k < 50 { 15.0 * is_there(y, x) } else { 0.0 }, 300), []);
        assert_eq!(odd(|_, _, x| if x == 7 { 5.0 } else { 0.0 }, 10).len(), PIXELS);
        // On a pixel, between two and between four; the faint one in a row with bright ones.
        for [y, x] in [[20.0, 20.0], [20.0, 20.5], [20.5, 20.5]] {
            for (peak, frames) in [(1.0, 400), (5.0, 400), (1000.0, 100)] {
                let beside = |at_x: f64| move |row: usize, column: usize| spot(row, column, [y, at_x], 3000.0);
                let light = |_: usize, row: usize, column: usize| {
                    let bright: f64 = [6.0, 30.0, 34.0].map(|at_x| beside(at_x)(row, column)).iter().sum();
                    bright + spot(row, column, [y, x], peak)
                };
                assert_eq!(odd(light, frames), [], "{y} {x} {peak}");
            }
        }
    }
}
