//! Finds spots without knowing their shape, and what only looks like one: hot pixels and the halo of a brighter spot.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::patch::Source;
use crate::optics::{Axis, Camera, psf};

/// Significance of a detection in standard deviations. Fainter spots teach nothing about the shape.
const SIGMAS: f64 = 8.0;

/// A local maximum of the matched filter.
#[derive(Clone, Copy, Debug)]
pub struct Peak {
    pub at: [f64; 2],
    pub energy_j: f64,
}

impl From<&Peak> for Source {
    fn from(peak: &Peak) -> Self {
        Self {
            at: peak.at,
            energy_j: peak.energy_j,
        }
    }
}

impl From<&Source> for Peak {
    fn from(source: &Source) -> Self {
        Self {
            at: source.at,
            energy_j: source.energy_j,
        }
    }
}

/// Matched filter with the camera's Gaussian on images of its shape.
pub struct MatchedFilter {
    x: Vec<Kernel>,
    y: Vec<Kernel>,
    norm2: f64,
}

/// A spot's profile around one pixel, as far as it has light.
struct Kernel {
    first: usize,
    weights: Vec<f64>,
}

/// Half of a kernel, σ: beyond it a pixel has less than 10⁻⁷ of the middle one's weight.
const KERNEL_RADIUS: f64 = 6.0;

impl MatchedFilter {
    pub fn new(camera: &Camera) -> Self {
        let sigma_m = camera.spot_sigma_m;
        let kernels = |axis: &Axis| -> Vec<Kernel> {
            let reach = (KERNEL_RADIUS * sigma_m / axis.pitch_m).ceil() as usize;
            (0..axis.n)
                .map(|k| {
                    let (first, last) = (k.saturating_sub(reach), (k + reach + 1).min(axis.n));
                    let fraction = |p| psf::pixel_fraction(axis.edge(p), axis.edge(p + 1), axis.centre(k), sigma_m);
                    let weights = (first..last).map(fraction).collect();
                    Kernel { first, weights }
                })
                .collect()
        };
        let (x, y) = (kernels(&camera.x), kernels(&camera.y));
        let norm = |k: &[Kernel]| k[k.len() / 2].weights.iter().map(|v| v * v).sum::<f64>();
        Self {
            norm2: norm(&x) * norm(&y),
            x,
            y,
        }
    }

    /// Local maxima of an image (J, row by row) above the noise, the brightest first.
    pub fn peaks(&self, camera: &Camera, image: &[f64], noise_j: f64) -> Vec<Peak> {
        let (ny, nx) = camera.shape();
        let mut along_x = vec![0.0; ny * nx];
        for (row, out) in image.chunks_exact(nx).zip(along_x.chunks_exact_mut(nx)) {
            for (o, kernel) in out.iter_mut().zip(&self.x) {
                *o = kernel
                    .weights
                    .iter()
                    .zip(&row[kernel.first..])
                    .map(|(a, b)| a * b)
                    .sum();
            }
        }
        let mut filtered = vec![0.0; ny * nx];
        for (kernel, out) in self.y.iter().zip(filtered.chunks_exact_mut(nx)) {
            for (w, line) in kernel.weights.iter().zip(along_x.chunks_exact(nx).skip(kernel.first)) {
                out.iter_mut().zip(line).for_each(|(o, v)| *o += w * v);
            }
        }
        let value = |j: usize, i: usize| filtered[j * nx + i];
        let mut peaks = Vec::new();
        let least = SIGMAS * noise_j * self.norm2.sqrt();
        for j in 0..ny {
            for i in 0..nx {
                let here = value(j, i);
                if here < least {
                    continue;
                }
                let (js, is) = (
                    j.saturating_sub(1)..(j + 2).min(ny),
                    i.saturating_sub(1)..(i + 2).min(nx),
                );
                if js
                    .flat_map(|b| is.clone().map(move |a| (b, a)))
                    .any(|(b, a)| value(b, a) > here)
                {
                    continue;
                }
                let at = [
                    camera.x.centre(i) + camera.x.pitch_m * vertex(i, nx, |a| value(j, a)),
                    camera.y.centre(j) + camera.y.pitch_m * vertex(j, ny, |b| value(b, i)),
                ];
                peaks.push(Peak {
                    at,
                    energy_j: here / self.norm2,
                });
            }
        }
        peaks.sort_by(|a, b| b.energy_j.total_cmp(&a.energy_j));
        peaks
    }
}

/// Offset of a parabola's vertex through three neighbours, in pixels.
fn vertex(k: usize, n: usize, value: impl Fn(usize) -> f64) -> f64 {
    if k == 0 || k + 1 == n {
        return 0.0;
    }
    let (a, b, c) = (value(k - 1), value(k), value(k + 1));
    let curvature = a - 2.0 * b + c;
    if curvature < 0.0 {
        (0.5 * (a - c) / curvature).clamp(-0.5, 0.5)
    } else {
        0.0
    }
}

/// Chooses from peaks those that are spots of their own: not within the halo that a brighter spot of an unknown shape may have.
/// `halo(d)` is the share of a spot's own peak that it may have at a distance of d m.
pub fn own_spots(peaks: &[Peak], brighter: &[Peak], halo: impl Fn(f64) -> f64) -> Vec<Peak> {
    let mut chosen: Vec<Peak> = Vec::new();
    for peak in peaks {
        let is_halo = chosen.iter().chain(brighter).any(|other| {
            let d = (peak.at[0] - other.at[0]).hypot(peak.at[1] - other.at[1]);
            peak.energy_j < halo(d) * other.energy_j
        });
        if !is_halo {
            chosen.push(*peak);
        }
    }
    chosen
}

/// The share of its peak that a spot of an unknown shape may have `widths` from its centre.
pub fn unknown_halo(widths: f64) -> f64 {
    match widths {
        d if d < 6.0 => 0.25,
        d if d < 15.0 => 0.05,
        _ => 0.02,
    }
}

/// Pixels that are brighter than any spot's light could make them beside their neighbours: hot ones and cosmic rays. Needs spots
/// wider than [`NARROWEST`] pixels.
pub fn single_pixels(camera: &Camera, image: &[f64], background_j: f64, noise_j: f64) -> Vec<usize> {
    let (ny, nx) = camera.shape();
    let width = camera.spot_sigma_m / camera.x.pitch_m.max(camera.y.pitch_m);
    if width < NARROWEST {
        return Vec::new();
    }
    // A quarter of what the brightest neighbour of the brightest pixel of a Gaussian half as wide would have.
    let share = 0.25 * (-0.5 / (0.5 * width).powi(2)).exp();
    let mut found = Vec::new();
    for j in 0..ny {
        for i in 0..nx {
            let own = image[j * nx + i] - background_j;
            if own < SIGMAS * noise_j {
                continue;
            }
            let mut neighbours = Vec::with_capacity(4);
            if i > 0 {
                neighbours.push(j * nx + i - 1);
            }
            if i + 1 < nx {
                neighbours.push(j * nx + i + 1);
            }
            if j > 0 {
                neighbours.push((j - 1) * nx + i);
            }
            if j + 1 < ny {
                neighbours.push((j + 1) * nx + i);
            }
            let brightest = neighbours
                .iter()
                .map(|p| image[*p] - background_j)
                .fold(f64::MIN, f64::max);
            if brightest + 3.0 * noise_j < share * own {
                found.push(j * nx + i);
            }
        }
    }
    found
}

/// Least σ of a spot in pixels for which single pixels can be told from spots.
const NARROWEST: f64 = 0.7;

/// Noise of one pixel, J, from what a pixel has beyond the mean of its neighbours, over frames of shape (Ny, Nx): spots are smooth
/// beside it, and the median leaves out those that are not.
pub fn pixel_noise<'a>(camera: &Camera, frames: impl Iterator<Item = &'a [f64]>) -> f64 {
    let (ny, nx) = camera.shape();
    let mut dither = Dither::of(camera);
    let mut each: Vec<f64> = frames
        .filter_map(|image| {
            let mut rough = Vec::with_capacity(ny * nx);
            let dithered: Vec<f64> = image.iter().map(|v| v + dither.next_j()).collect();
            for row in dithered.chunks_exact(nx) {
                for w in row.windows(3) {
                    rough.push((w[1] - 0.5 * (w[0] + w[2])).abs());
                }
            }
            crate::stats::median(rough.into_iter().filter(|v| v.is_finite()).collect())
        })
        // The variance of w₁ − (w₀ + w₂)/2 is 1.5 σ²; a median magnitude is 0.6745 σ.
        .map(|m| m / 0.6745 / 1.5_f64.sqrt())
        .collect();
    each.sort_by(f64::total_cmp);
    dither.taken_off(each.get(each.len() / 2).copied().unwrap_or(0.0))
}

/// Even noise of one count, by which whole counts become values whose median says how they scatter (Schuchman, 1964).
pub struct Dither {
    rng: ChaCha8Rng,
    step_j: f64,
}

impl Dither {
    pub fn of(camera: &Camera) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(0),
            step_j: camera.joules_per_count.unwrap_or(0.0),
        }
    }

    pub fn next_j(&mut self) -> f64 {
        self.step_j * self.rng.random_range(-0.5..0.5)
    }

    /// A standard deviation of dithered values without the dither, J.
    pub fn taken_off(&self, std_j: f64) -> f64 {
        (std_j * std_j - self.step_j * self.step_j / 12.0).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};

    use super::*;

    #[test]
    fn the_noise_of_whole_counts_is_theirs_however_coarse() {
        for counts in [0.4, 1.0, 5.0] {
            let config = crate::optics::Config {
                joules_per_count: Some(1e-6),
                ..Default::default()
            };
            let camera = config.camera().unwrap();
            let (ny, nx) = camera.shape();
            let mut rng = ChaCha8Rng::seed_from_u64(3);
            let normal: Normal<f64> = Normal::new(20.3, counts).unwrap();
            let image: Vec<f64> = (0..ny * nx).map(|_| 1e-6 * normal.sample(&mut rng).round()).collect();
            let found = pixel_noise(&camera, [image.as_slice()].into_iter());
            let mean = image.iter().sum::<f64>() / image.len() as f64;
            let truth = (image.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / image.len() as f64).sqrt();
            assert!((found / truth - 1.0).abs() < 0.1, "{counts}: {found} {truth}");
        }
    }
}
