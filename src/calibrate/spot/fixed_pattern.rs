//! What each pixel shows beside its neighbours in all frames: a camera's fixed pattern of dark levels. Spots are looked for without it, and noise
//! is what is left.

use super::grouping::Image;
use crate::stats::median;

/// Scatter of the pixels' medians over what noise makes of them from which there is a pattern.
const SHOWS: f64 = 2.0;
/// Noise of a pixel over that of most beyond which light comes and goes there, and scatters of the pattern beyond which it is a spot that
/// stays, or a bad pixel.
const UNSTEADY: f64 = 1.5;
const ODD: f64 = 6.0;
/// Of a Gaussian, standard deviations per median magnitude, and those of a median per that of a mean.
const PER_MEDIAN: f64 = 1.4826;
const OF_MEDIAN: f64 = 1.2533;
/// Scatter of medians of whole counts, over the noise that rounding makes: they are one count or the next.
const OF_COUNTS: f64 = 2.6;

/// The pattern, (Ny, Nx) row by row with `nx` columns, J, where it shows beyond the noise; `middle` is the median of each pixel over the images.
pub fn of(nx: usize, images: &[Image], middle: &[f64], least_noise_j: f64) -> Option<Vec<f64>> {
    let magnitude = |p: usize| {
        median(
            images
                .iter()
                .map(|i| (i.pixels[p] - i.level - middle[p]).abs())
                .collect(),
        )
    };
    let noise: Vec<f64> = (0..middle.len())
        .map(|p| PER_MEDIAN * magnitude(p).unwrap_or(0.0))
        .collect();
    let usual_j = median(noise.clone())?.max(least_noise_j);
    let beside: Vec<f64> = (0..middle.len()).map(|p| middle[p] - around(nx, middle, p)).collect();
    let scatter = PER_MEDIAN * median(beside.iter().map(|v| v.abs()).collect())?;
    let by_noise = (OF_MEDIAN * usual_j / (images.len() as f64).sqrt()).hypot(OF_COUNTS * least_noise_j);
    let pattern = beside.into_iter().zip(noise).map(|(v, noise)| {
        let is_own = noise <= UNSTEADY * usual_j && v.abs() <= ODD * scatter;
        if is_own { v } else { 0.0 }
    });
    (scatter > SHOWS * by_noise).then(|| pattern.collect())
}

/// Median of the pixels two to either side.
fn around(nx: usize, image: &[f64], p: usize) -> f64 {
    let ny = image.len() / nx;
    let [xs, ys] = [(p % nx, nx), (p / nx, ny)].map(|(k, n)| k.saturating_sub(2)..(k + 3).min(n));
    median(ys.flat_map(|y| xs.clone().map(move |x| image[y * nx + x])).collect()).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn a_pattern_is_found_beside_a_spot_that_stays_and_none_in_noise() {
        let (nx, count) = (24, 60);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let truth: Vec<f64> = (0..nx * nx).map(|_| normal()).collect();
        let mut found = |scale: f64| {
            let images: Vec<Image> = (0..count)
                .map(|k| {
                    let spot = |p: usize| {
                        let (x, y) = ((p % nx) as f64 - 12.0, (p / nx) as f64 - 12.0);
                        (20.0 + 10.0 * f64::from(k % 3)) * (-0.25 * (x * x + y * y)).exp()
                    };
                    let pixels: Vec<f64> = (0..nx * nx).map(|p| scale * truth[p] + spot(p) + normal()).collect();
                    Image {
                        level: 0.0,
                        weight: vec![1.0; pixels.len()],
                        pixels,
                    }
                })
                .collect();
            let middle: Vec<f64> = (0..nx * nx)
                .map(|p| median(images.iter().map(|i| i.pixels[p]).collect()).unwrap())
                .collect();
            of(nx, &images, &middle, 0.1)
        };
        assert_eq!(found(0.0), None);
        let pattern = found(2.0).expect("twice the noise");
        let off = |p: &usize| pattern[*p] - 2.0 * truth[*p];
        let dark = (0..nx * nx).filter(|p| pattern[*p] != 0.0);
        let count = dark.clone().count();
        let left = (dark.map(|p| off(&p).powi(2)).sum::<f64>() / count as f64).sqrt();
        // A median of 25 is known to a quarter of the pattern.
        assert!(count > 500 && left < 0.7, "{count} {left}");
        assert_eq!(pattern[12 * nx + 12], 0.0);
    }
}
