//! The first look at a camera of which nothing is known: noise, curve, bad pixels and the width of spots, from frames of raw counts.

use ndarray::{Array2, s};

use super::bad_pixels::bad_pixels;
use super::photon_transfer::{self, PhotonTransfer, mean_of};
use crate::stats::median;

/// What frames show of a camera.
#[derive(Clone, Debug)]
pub struct FirstLook {
    /// Noise against light, or why it cannot be told.
    pub noise: Result<PhotonTransfer, String>,
    pub bad: Array2<bool>,
    /// Pixels that reached saturation in some frame.
    pub saturated: usize,
    /// Spots that stand apart and are not saturated, the brightest first.
    pub spots: Vec<FoundSpot>,
    /// Share of pixels that are much brighter than the darkest ones. Of a dark scene with a few beams it is a few per cent.
    pub lit_share: f64,
}

/// A spot of the mean image, in pixels; 0 is the first pixel's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundSpot {
    pub x: f64,
    pub y: f64,
    pub peak_counts: f64,
    /// Standard deviation of the light, without what the pixel adds.
    pub sigma: f64,
}

/// A spot's peak is at least this many standard deviations of the mean image's noise above its surroundings: a tenth of that moves its
/// width by about a hundredth.
const BRIGHT: f64 = 100.0;
/// A pixel is lit from this many standard deviations of one frame's noise above the darkest tenth on.
const LIT: f64 = 5.0;
/// Most spots that are measured.
const MOST_SPOTS: usize = 20;
/// Widths that are looked for, pixels. Below the least, most light is in one pixel and its width is not in the image.
const WIDTHS: std::ops::RangeInclusive<f64> = 0.3..=40.0;

/// Looks at frames of one scene at one setting. A pixel at or above `saturation` is saturated. `dark` are frames without light. Values
/// are rounded to multiples of `step`: 1 for counts, 0 for joules.
pub fn look(frames: &[Array2<f64>], saturation: f64, dark: &[Array2<f64>], step: f64) -> FirstLook {
    let unlit = if dark.is_empty() { frames } else { dark };
    let bad = bad_pixels(unlit, step);
    let dark_counts = match dark.is_empty() {
        true => None,
        false => median(mean_of(dark).into_iter().collect()),
    };
    let noise = photon_transfer::measure(frames, saturation, &bad, dark_counts);
    let mut reached = Array2::from_elem(bad.dim(), false);
    for frame in frames {
        reached.zip_mut_with(frame, |reached, value| *reached |= *value >= saturation);
    }
    let mean = mean_of(frames);
    let (mut spots, mut lit_share) = (Vec::new(), 0.0);
    if let Ok(noise) = &noise {
        let one_frame = noise.read_variance.max(step * step / 12.0).sqrt();
        let mut sorted: Vec<f64> = mean.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let ground = sorted[sorted.len() / 10];
        let lit = mean.iter().filter(|v| **v > ground + LIT * one_frame).count();
        lit_share = lit as f64 / mean.len() as f64;
        let unusable = Array2::from_shape_fn(bad.dim(), |at| bad[at] || reached[at]);
        spots = spots_of(&mean, &unusable, one_frame / (frames.len() as f64).sqrt());
    }
    FirstLook {
        noise,
        saturated: reached.iter().filter(|r| **r).count(),
        bad,
        spots,
        lit_share,
    }
}

impl FirstLook {
    /// Median width of the spots, pixels.
    pub fn spot_sigma(&self) -> Option<f64> {
        median(self.spots.iter().map(|s| s.sigma).collect())
    }
}

/// Spots of the mean image whose light is that of one Gaussian.
fn spots_of(mean: &Array2<f64>, unusable: &Array2<bool>, noise: f64) -> Vec<FoundSpot> {
    const AROUND: usize = 2;
    let (ny, nx) = mean.dim();
    let ground = median(mean.iter().copied().collect()).unwrap_or_default();
    let mut peaks: Vec<(usize, usize)> = Vec::new();
    for ((y, x), value) in mean.indexed_iter() {
        if *value < ground + BRIGHT * noise || unusable[[y, x]] {
            continue;
        }
        let window = s![
            y.saturating_sub(AROUND)..(y + AROUND + 1).min(ny),
            x.saturating_sub(AROUND)..(x + AROUND + 1).min(nx)
        ];
        let is_peak = mean.slice(window).iter().all(|v| v <= value) && !unusable.slice(window).iter().any(|u| *u);
        if is_peak {
            peaks.push((y, x));
        }
    }
    peaks.sort_by(|a, b| mean[*b].total_cmp(&mean[*a]));
    let mut spots: Vec<FoundSpot> = Vec::new();
    // Noise on the flank of a wide spot makes peaks of its own.
    for peak in peaks.into_iter().take(50 * MOST_SPOTS) {
        let inside = |s: &FoundSpot| (s.x - peak.1 as f64).hypot(s.y - peak.0 as f64) < 4.0 * s.sigma;
        if spots.len() < MOST_SPOTS
            && !spots.iter().any(inside)
            && let Some(spot) = moments(mean, peak)
        {
            spots.push(spot);
        }
    }
    spots
}

/// Place and width by moments under a Gaussian weight of about the spot's own width (Bernstein and Jarvis, 2002, section 3.1): for a
/// Gaussian spot of variance v and a weight of variance w, the weighted second moment m obeys 1/m = 1/v + 1/w.
fn moments(mean: &Array2<f64>, (row, column): (usize, usize)) -> Option<FoundSpot> {
    /// What a square pixel adds to a spot's variance, px².
    const PIXEL: f64 = 1.0 / 12.0;
    /// Least variance of the weight, px²: a narrower product with the spot is not sampled finely enough by pixels (2 % at σ 0.6).
    const NARROWEST: f64 = 1.5;
    let (ny, nx) = mean.dim();
    let (mut x, mut y, mut variance) = (column as f64, row as f64, 1.5f64.powi(2));
    for _ in 0..100 {
        let weight = variance.max(NARROWEST);
        let reach = (4.0 * variance.sqrt()).ceil().max(3.0);
        let inside = x >= reach && y >= reach && x + reach < nx as f64 && y + reach < ny as f64;
        if !inside || !WIDTHS.contains(&variance.sqrt()) {
            return None;
        }
        let (x0, y0) = ((x - reach) as usize, (y - reach) as usize);
        let window = mean.slice(s![y0..=(y + reach) as usize, x0..=(x + reach) as usize]);
        let edge = window.indexed_iter().filter(|((i, j), _)| {
            let r2 = ((y0 + i) as f64 - y).powi(2) + ((x0 + j) as f64 - x).powi(2);
            r2 > (0.9 * reach).powi(2)
        });
        let ground = median(edge.map(|(_, v)| *v).collect()).unwrap_or_default();
        let mut sums = [0.0; 4];
        for ((i, j), value) in window.indexed_iter() {
            let (dy, dx) = ((y0 + i) as f64 - y, (x0 + j) as f64 - x);
            let light = (value - ground) * (-0.5 * (dx * dx + dy * dy) / weight).exp();
            let parts = [light, light * dx, light * dy, light * (dx * dx + dy * dy)];
            sums.iter_mut().zip(parts).for_each(|(sum, part)| *sum += part);
        }
        let [light, at_x, at_y, second] = sums;
        let (dx, dy) = (at_x / light, at_y / light);
        let weighted = 0.5 * (second / light - dx * dx - dy * dy);
        let next = 1.0 / (1.0 / weighted - 1.0 / weight);
        if !(next.is_finite() && next > 0.0 && light > 0.0) {
            return None;
        }
        // The centroid under the weight moves a part of the way.
        let rest = 1.0 + variance / weight;
        (x, y) = (x + rest * dx, y + rest * dy);
        if (x - column as f64).hypot(y - row as f64) > 3.0 + next.sqrt() {
            return None;
        }
        let change = next / variance;
        variance *= change.clamp(0.5, 2.0);
        if (change - 1.0).abs() < 1e-6 {
            let sigma = (variance - PIXEL).max(0.01).sqrt();
            return WIDTHS.contains(&sigma).then_some(FoundSpot {
                x,
                y,
                peak_counts: mean[[row, column]] - ground,
                sigma,
            });
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Light of Gaussian spots, averaged over each pixel, on an even ground.
    fn image(spots: &[(f64, f64, f64)], sigma: f64) -> Array2<f64> {
        const FINE: usize = 8;
        Array2::from_shape_fn((80, 90), |(row, column)| {
            let mut light = 50.0;
            for (x, y, peak) in spots {
                for k in 0..FINE * FINE {
                    let offset = |k: usize| (k as f64 + 0.5) / FINE as f64 - 0.5;
                    let dx = column as f64 + offset(k % FINE) - x;
                    let dy = row as f64 + offset(k / FINE) - y;
                    light += peak / (FINE * FINE) as f64 * (-0.5 * (dx * dx + dy * dy) / (sigma * sigma)).exp();
                }
            }
            light
        })
    }

    #[test]
    fn widths_of_spots_are_found_within_two_per_cent() {
        for sigma in [0.6, 1.0, 2.0, 3.7] {
            let spots = [(20.3, 21.8, 900.0), (60.9, 30.1, 2000.0), (45.0, 60.5, 400.0)];
            let mean = image(&spots, sigma);
            let found = spots_of(&mean, &Array2::from_elem(mean.dim(), false), 0.1);
            assert_eq!(found.len(), 3, "{sigma}: {found:?}");
            for spot in found {
                assert!((spot.sigma / sigma - 1.0).abs() < 0.02, "{sigma}: {spot:?}");
                let near = |s: &&(f64, f64, f64)| (s.0 - spot.x).hypot(s.1 - spot.y) < 0.05;
                assert!(spots.iter().any(|s| near(&s)), "{spot:?}");
            }
        }
    }

    #[test]
    fn a_spot_that_is_saturated_or_cut_off_has_no_width() {
        let mean = image(&[(40.0, 40.0, 900.0), (1.0, 60.0, 900.0)], 2.0);
        let mut unusable = Array2::from_elem(mean.dim(), false);
        unusable[[40, 40]] = true;
        assert_eq!(spots_of(&mean, &unusable, 0.1), []);
    }
}
