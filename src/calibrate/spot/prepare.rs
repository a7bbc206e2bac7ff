//! Frames as they are recorded to images that can be learned from: noise, saturation, hot pixels.

use ndarray::Array2;

use super::band::pixels_within;
use super::detection;
use super::fixed_pattern;
use super::grouping::Image;
use super::stray_light;
use crate::optics::{Camera, PixelMaps};
use crate::stats::{is_cut_off, median};

/// Half-width of what is left out around a saturated pixel, σ: further out a saturated spot's halo is below that of others.
const AROUND_SATURATED: f64 = 6.0;
/// The largest value of a recording is taken for saturation where this many pixels have exactly it.
const REPEATED: usize = 12;

/// What was found before any shape is known.
#[derive(Clone, Debug)]
pub struct Prepared {
    pub images: Vec<Image>,
    pub noise_j: f64,
    /// What whole counts add at least, J.
    least_noise_j: f64,
    /// Dark levels that were taken off, J, row by row; none where pixels are alike.
    pub pattern_j: Option<Vec<f64>>,
    /// Level at which pixels saturate, J, from the config or seen.
    pub saturation_j: Option<f64>,
    /// Frames with a saturated pixel.
    pub saturated_frames: usize,
    /// Frames that are cut off at their darkest value.
    pub cut_off_frames: usize,
    /// Pixels (index, row by row) that are hot in most frames.
    pub hot: Vec<usize>,
    /// Pixels that are hot in a single frame, over all frames.
    pub flashes: usize,
}

impl Prepared {
    /// Takes pixels of single images, by their indices, out of use.
    pub fn mask_flashes(&mut self, flashes: &[(usize, usize)]) {
        self.flashes += flashes.len();
        flashes.iter().for_each(|(k, p)| self.images[*k].weight[*p] = 0.0);
    }

    /// Takes bad pixels out of use in all images. Returns whether any was in use.
    pub fn mask_bad(&mut self, maps: Option<&PixelMaps>) -> bool {
        let bad = maps.into_iter().flat_map(|maps| maps.bad.iter().enumerate());
        let is_used = |p: &usize| self.images.iter().any(|image| image.weight[*p] > 0.0);
        let new: Vec<usize> = bad.filter(|(_, bad)| **bad).map(|(p, _)| p).filter(is_used).collect();
        for p in &new {
            self.images.iter_mut().for_each(|image| image.weight[*p] = 0.0);
        }
        self.hot.extend(&new);
        !new.is_empty()
    }

    /// Takes more of the dark levels off, J.
    pub fn take_off(&mut self, dark_j: &Array2<f64>) {
        let pattern = self.pattern_j.get_or_insert_with(|| vec![0.0; dark_j.len()]);
        subtract(self.images.iter_mut().map(|image| &mut image.pixels), dark_j);
        pattern.iter_mut().zip(dark_j).for_each(|(v, own)| *v += own);
    }

    /// Corrects all images by pixel maps: gain, dark level, bad pixels.
    pub fn correct(&mut self, maps: &PixelMaps) {
        for image in &mut self.images {
            for (p, ((gain, dark), bad)) in maps.gain.iter().zip(&maps.dark_j).zip(&maps.bad).enumerate() {
                image.pixels[p] = (image.pixels[p] - dark) / gain;
                // A pixel of low gain has its noise raised by the division.
                image.weight[p] *= if *bad { 0.0 } else { *gain };
            }
        }
    }

    /// Replaces the noise by `factor` times what it was taken for.
    pub fn scale_noise(&mut self, factor: f64) {
        let factor = factor.max(self.least_noise_j / self.noise_j);
        self.noise_j *= factor;
        let weights = self.images.iter_mut().flat_map(|image| &mut image.weight);
        weights.for_each(|w| *w /= factor);
    }
}

/// Prepares frames of shape (Ny, Nx), J, numbered as in the recording.
pub fn prepare(camera: &Camera, frames: &[(usize, &Array2<f64>)]) -> Prepared {
    let saturation_j = camera.saturation_j.or_else(|| repeated_maximum(frames));
    let limit = saturation_j.unwrap_or(f64::INFINITY);
    let clean = |v: f64| if v.is_finite() { v } else { 0.0 };
    let mut images: Vec<Image> = frames
        .iter()
        .map(|(_, pixels)| {
            let weight: Vec<f64> = pixels
                .iter()
                .map(|v| f64::from(u8::from(v.is_finite() && *v < limit)))
                .collect();
            Image {
                level: median(pixels.iter().copied().filter(|v| v.is_finite() && *v < limit).collect()).unwrap_or(0.0),
                pixels: pixels.iter().map(|v| clean(*v)).collect(),
                weight,
            }
        })
        .collect();
    let least_noise_j = camera
        .joules_per_count
        .map_or(f64::MIN_POSITIVE, |c| c / 12.0_f64.sqrt());
    let pixel_noise = |images: &[Image]| {
        detection::pixel_noise(camera, images.iter().map(|i| i.pixels.as_slice())).max(least_noise_j)
    };
    let mut noise_j = pixel_noise(&images);

    let saturated_frames = images
        .iter_mut()
        .filter_map(|image| spare_saturated(camera, image, limit))
        .count();
    let mut middle = middle_image(&images);
    if let Some(stray) = stray_light::of(camera, &images, &middle, noise_j) {
        subtract(images.iter_mut().map(|i| &mut i.pixels).chain([&mut middle]), &stray);
    }
    let pattern_j = fixed_pattern::of(camera.x.n, &images, &middle, least_noise_j);
    if let Some(pattern) = &pattern_j {
        subtract(images.iter_mut().map(|i| &mut i.pixels).chain([&mut middle]), pattern);
        noise_j = pixel_noise(&images);
    }
    // The standard deviation of a median is 1.25 σ/√T.
    let std = 1.25 * noise_j / (images.len() as f64).sqrt();
    let level = median(middle.clone()).unwrap_or(0.0);
    let hot = detection::single_pixels(camera, &middle, level, std);
    let mut flashes = 0;
    for image in &mut images {
        for p in detection::single_pixels(camera, &image.pixels, image.level, noise_j) {
            if image.weight[p] > 0.0 && !hot.contains(&p) {
                flashes += 1;
            }
            image.weight[p] = 0.0;
        }
        hot.iter().for_each(|p| image.weight[*p] = 0.0);
        image.weight.iter_mut().for_each(|w| *w /= noise_j);
    }
    Prepared {
        images,
        noise_j,
        least_noise_j,
        pattern_j,
        saturation_j,
        saturated_frames,
        cut_off_frames: frames
            .iter()
            .filter(|(_, pixels)| is_cut_off(pixels.iter().copied()))
            .count(),
        hot,
        flashes,
    }
}

fn subtract<'a, 'b>(
    images: impl Iterator<Item = &'a mut Vec<f64>>,
    from_each: impl IntoIterator<Item = &'b f64> + Copy,
) {
    images.for_each(|pixels| pixels.iter_mut().zip(from_each).for_each(|(v, own)| *v -= own));
}

/// The largest value of all frames where pixels have it again and again, as no noise would.
fn repeated_maximum(frames: &[(usize, &Array2<f64>)]) -> Option<f64> {
    let values = || {
        frames
            .iter()
            .flat_map(|(_, pixels)| pixels.iter().copied().filter(|v| v.is_finite()))
    };
    let largest = values().fold(f64::NEG_INFINITY, f64::max);
    // In frames that hold little but noise the largest count is repeated as well.
    let common = median(values().step_by(7).collect())?;
    let spread = median(values().step_by(7).map(|v| (v - common).abs()).collect())?;
    let is_far = largest - common > 20.0 * spread;
    (is_far && values().filter(|v| *v == largest).count() >= REPEATED).then_some(largest)
}

/// Takes out of use what surrounds saturated pixels; none where there are none.
fn spare_saturated(camera: &Camera, image: &mut Image, limit: f64) -> Option<()> {
    let nx = camera.x.n;
    let saturated: Vec<usize> = (0..image.pixels.len()).filter(|p| image.pixels[*p] >= limit).collect();
    let reach = AROUND_SATURATED * camera.spot_sigma_m;
    for p in &saturated {
        let [x, y] = [camera.x.centre(p % nx), camera.y.centre(p / nx)];
        for j in pixels_within(&camera.y, y, reach) {
            for i in pixels_within(&camera.x, x, reach) {
                image.weight[j * nx + i] = 0.0;
            }
        }
    }
    (!saturated.is_empty()).then_some(())
}

/// Median of each pixel over the frames.
fn middle_image(images: &[Image]) -> Vec<f64> {
    let count = images.first().map_or(0, |i| i.pixels.len());
    (0..count)
        .map(|p| median(images.iter().map(|i| i.pixels[p] - i.level).collect()).unwrap_or(0.0))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bad_pixel_is_taken_out_of_all_images_once() {
        let image = Image {
            pixels: vec![0.0; 6],
            weight: vec![1.0; 6],
            level: 0.0,
        };
        let mut prepared = Prepared {
            images: vec![image; 3],
            noise_j: 1.0,
            least_noise_j: 0.0,
            pattern_j: None,
            saturation_j: None,
            saturated_frames: 0,
            cut_off_frames: 0,
            hot: Vec::new(),
            flashes: 0,
        };
        let mut maps = PixelMaps::ideal((2, 3));
        assert!(!prepared.mask_bad(None) && !prepared.mask_bad(Some(&maps)));
        maps.bad[(1, 0)] = true;
        assert!(prepared.mask_bad(Some(&maps)) && !prepared.mask_bad(Some(&maps)));
        assert_eq!(prepared.hot, [3]);
        let used = prepared
            .images
            .iter()
            .map(|i| i.weight.iter().filter(|w| **w > 0.0).count());
        assert_eq!(used.collect::<Vec<_>>(), [5, 5, 5]);
    }
}
