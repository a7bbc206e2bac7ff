//! Pixels whose light is no spot's: hot ones, ones that flicker, and those of a line that is off.

use ndarray::Array2;

use crate::optics::psf::pixel_fraction;
use crate::optics::{Axis, Camera};
use crate::stats::median;

/// Frames over which light is summed. More find fainter pixels, fewer forget sooner what has passed. Not tuned.
const FRAMES: f64 = 32.0;
/// Least decrease of the deviance by a pixel's light, and below which one that was odd no longer is. Noise exceeds the first in no pixel of a
/// million frames.
const LEAST: f64 = 45.0;
const STAYS: f64 = 12.0;
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

/// The light of each pixel, summed over frames, older ones fading.
pub(crate) struct OddPixels {
    /// In standard deviations of one frame's noise.
    light: Array2<f64>,
    frames: f64,
    /// Variance of that sum where it is noise.
    variance: f64,
    is_odd: Array2<bool>,
    count: usize,
    /// A spot on a pixel's middle along x and y, from there outwards.
    profiles: [Vec<f64>; 2],
}

impl OddPixels {
    pub fn new(camera: &Camera) -> Self {
        let profile = |axis: &Axis| {
            let (sigma, pitch) = (camera.spot_sigma_m, axis.pitch_m);
            let reach = (REACH * sigma / pitch).ceil().max(1.0) as usize;
            let edge = |k: usize| (k as f64 - 0.5) * pitch;
            let pixel = |k: usize| pixel_fraction(edge(k), edge(k + 1), 0.0, sigma);
            (0..=reach).map(pixel).collect()
        };
        Self {
            light: Array2::zeros(camera.shape()),
            frames: 0.0,
            variance: 0.0,
            is_odd: Array2::default(camera.shape()),
            count: 0,
            profiles: [profile(&camera.x), profile(&camera.y)],
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
        let dark = self.light.iter().zip(is_lit).filter(|(_, lit)| !**lit);
        let middle = median(dark.map(|(light, _)| light.abs()).collect());
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

    /// Learns from a frame's pixels (ny, nx), in standard deviations of the noise, NaN where they are not usable.
    pub fn learn(&mut self, values: &Array2<f64>) {
        let keep = 1.0 - 1.0 / FRAMES;
        self.frames = keep * self.frames + 1.0;
        self.variance = keep * keep * self.variance + 1.0;
        self.light.zip_mut_with(values, |sum, v| {
            *sum = keep * *sum + if v.is_nan() { 0.0 } else { *v };
        });
        let [least, stays] = [LEAST, STAYS].map(|share| share * self.frames);
        for at in self.asked(least) {
            let was_odd = self.is_odd[at];
            let is_odd = match was_odd {
                true => self.light[at].powi(2) > stays,
                false => self.is_no_spot(at),
            };
            self.is_odd[at] = is_odd;
            self.count += usize::from(is_odd);
            self.count -= usize::from(was_odd);
        }
    }

    /// Odd pixels, and those of more light than noise has that are brighter than their diagonal neighbours.
    fn asked(&self, least: f64) -> Vec<(usize, usize)> {
        let (ny, nx) = self.light.dim();
        let mut asked = Vec::new();
        for y in 0..ny {
            let (row, odd) = (self.light.row(y), self.is_odd.row(y));
            let [above, below] = [y.saturating_sub(1), (y + 1).min(ny - 1)].map(|y| self.light.row(y));
            for x in 0..nx {
                let [left, right] = [x.saturating_sub(1), (x + 1).min(nx - 1)];
                let diagonal = || above[left] + above[right] + below[left] + below[right];
                let light = row[x];
                let is_above = || 4.0 * light.abs() > ABOVE_NEIGHBOURS * f64::abs(diagonal());
                if odd[x] || light * light > least && is_above() {
                    asked.push((y, x));
                }
            }
        }
        asked
    }

    /// Whether a pixel's own light, or that of its row or column, explains more than a spot's there.
    fn is_no_spot(&self, (y, x): (usize, usize)) -> bool {
        let (ny, nx) = self.light.dim();
        let [along, across] = &self.profiles;
        let (mut fits, mut norm) = (0.0, 0.0);
        for row in (y + 1).saturating_sub(across.len())..(y + across.len()).min(ny) {
            for column in (x + 1).saturating_sub(along.len())..(x + along.len()).min(nx) {
                let share = along[x.abs_diff(column)] * across[y.abs_diff(row)];
                fits += share * self.light[(row, column)];
                norm += share * share;
            }
        }
        let peak = along[0] * across[0];
        let squared = |sum: f64, pixels: usize| sum * sum / pixels as f64;
        let own = squared(self.light[(y, x)], 1)
            .max(squared(self.light.row(y).sum(), nx))
            .max(squared(self.light.column(x).sum(), ny));
        norm > LEAST_SPREAD * peak * peak && own > fits * fits / norm
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::optics::Config;

    const PIXELS: usize = 40;
    const AT: (usize, usize) = (20, 12);

    /// The pixels that are odd after so many frames in which `light(frame, y, x)` is added to noise.
    fn odd(light: impl Fn(usize, usize, usize) -> f64, frames: usize) -> Vec<(usize, usize)> {
        let config = Config {
            pixels: [PIXELS; 2],
            spot_sigma_m: Some(1e-3),
            ..Config::default()
        };
        let mut odd = OddPixels::new(&config.camera().expect("a sound config"));
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for k in 0..frames {
            odd.learn(&Array2::from_shape_fn((PIXELS, PIXELS), |(y, x)| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                noise + light(k, y, x)
            }));
        }
        let found = odd.pixels().indexed_iter().filter(|(_, odd)| **odd);
        found.map(|(at, _)| at).collect()
    }

    #[test]
    fn a_pattern_of_all_pixels_is_told_from_noise() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let config = Config {
            pixels: [PIXELS; 2],
            ..Config::default()
        };
        let camera = config.camera().expect("a sound config");
        let mut noise = || -> f64 { StandardNormal.sample(&mut rng) };
        let shape = (PIXELS, PIXELS);
        let pattern = Array2::from_shape_simple_fn(shape, &mut noise);
        for (scatter, scale, expected) in [(0.0, 1.0, false), (0.0, 1.2, false), (0.2, 1.0, true)] {
            let mut odd = OddPixels::new(&camera);
            for _ in 0..100 {
                odd.learn(&(Array2::from_shape_simple_fn(shape, &mut noise) * scale + &pattern * scatter));
            }
            assert_eq!(odd.are_all(&Array2::default(shape)), expected, "{scatter} {scale}");
        }
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
        // σ is 1.3 pixels; a middle between pixels, and one on a pixel.
        for middle in [20.0, 20.5] {
            for peak in [1.0, 10.0, 1000.0] {
                let spot = |y: usize, x: usize| {
                    let away2 = (y as f64 - middle).powi(2) + (x as f64 - middle).powi(2);
                    peak * (-0.5 * away2 / 1.33f64.powi(2)).exp()
                };
                assert_eq!(odd(|_, y, x| spot(y, x), 100), [], "{middle} {peak}");
            }
        }
    }
}
