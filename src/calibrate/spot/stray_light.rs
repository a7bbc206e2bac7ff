//! A background that rises or is curved across the sensor, the same in all frames: stray light, or daylight through a lens that is darker at its
//! edge. Spots are looked for on a level one.

use nalgebra::{Matrix6, SMatrix, SVector, Vector6};
use rayon::prelude::*;

use super::detection::{self, MatchedFilter};
use super::grouping::Image;
use crate::optics::Camera;
use crate::stats::median;

/// Rounds of reweighting, and the distance, in median deviations, at which a pixel's weight is a half (Cauchy): spots that stand still are
/// in every frame.
const ROUNDS: usize = 20;
const HALF_WEIGHT: f64 = 2.0;
/// Share of the median deviation that a surface may leave: light of spots is none.
const LEAVES: f64 = 0.5;
/// Distance from a spot, σ, beyond which it has a halo only.
const OUTSIDE: f64 = 4.0;
/// Powers of the distance with which halos fall: scattered light, an aperture's diffraction, a Moffat's wing.
const FALLS: [i32; 3] = [2, 3, 5];
/// Images that halos are measured in, at most.
const MOST_IMAGES: usize = 60;
/// Beside a diagonal of ones: powers that no pixel tells apart stay small.
const RIDGE: f64 = 1e-9;
/// Terms of a surface without its constant.
const TERMS: usize = 5;
const UNKNOWNS: usize = TERMS + FALLS.len();

/// The quadratic surface that all images have in common, (Ny, Nx) row by row, J, zero in its middle; `None` where none shows beyond a pixel's noise
/// that is not the halos of spots, which come and go with them. `middle` is the median of each pixel over the images.
pub fn of(camera: &Camera, images: &[Image], middle: &[f64], noise_j: f64) -> Option<Vec<f64>> {
    let terms = Terms::new(camera);
    let with_halos = terms.surface(middle, noise_j)?;
    let step = images.len().div_ceil(MOST_IMAGES).max(1);
    let images: Vec<&Image> = images.iter().step_by(step).collect();
    let outside = Outside::of(camera, &images, &with_halos, noise_j);
    let halo = outside.halo(&images, &terms)?;
    terms.surface(&outside.middle(&images, &halo), noise_j)
}

/// Polynomials over the sensor at each pixel.
struct Terms(Vec<Vector6<f64>>);

impl Terms {
    fn new(camera: &Camera) -> Self {
        let (ny, nx) = camera.shape();
        let along = |k: usize, n: usize| 2.0 * (k as f64 + 0.5) / n as f64 - 1.0;
        let pixel = |p: usize| terms_at(along(p % nx, nx), along(p / nx, ny));
        Self((0..ny * nx).map(pixel).collect())
    }

    /// Through the finite pixels of an image, zero in its middle; `None` where it does not show.
    fn surface(&self, image: &[f64], noise_j: f64) -> Option<Vec<f64>> {
        let known = || image.iter().zip(&self.0).filter(|(v, _)| v.is_finite());
        let deviation = |surface: &Vector6<f64>| median(known().map(|(v, row)| (v - row.dot(surface)).abs()).collect());
        let mut surface = Vector6::zeros();
        surface[0] = median(known().map(|(v, _)| *v).collect())?;
        let before = deviation(&surface)?;
        let mut scale = before;
        for _ in 0..ROUNDS {
            let (mut information, mut vector) = (Matrix6::zeros(), Vector6::zeros());
            for (v, row) in known() {
                let off = (v - row.dot(&surface)) / (HALF_WEIGHT * scale).max(f64::MIN_POSITIVE);
                let weight = 1.0 / (1.0 + off * off);
                information += row * row.transpose() * weight;
                vector += row * *v * weight;
            }
            surface = information.cholesky()?.solve(&vector);
            scale = deviation(&surface)?;
        }
        let level = terms_at(0.0, 0.0).dot(&surface);
        let rises: Vec<f64> = self.0.iter().map(|row| row.dot(&surface) - level).collect();
        let [low, high] = [f64::min, f64::max].map(|of| rises.iter().copied().fold(0.0, of));
        (high - low > noise_j && scale < LEAVES * before).then_some(rises)
    }
}

fn terms_at(x: f64, y: f64) -> Vector6<f64> {
    Vector6::new(1.0, x, y, 1.5 * x * x - 0.5, x * y, 1.5 * y * y - 0.5)
}

/// For each image what a halo of each power has at each pixel outside of spots.
struct Outside(Vec<Vec<Option<Halo>>>);

type Halo = SVector<f64, { FALLS.len() }>;
type Row = SVector<f64, UNKNOWNS>;

impl Outside {
    fn of(camera: &Camera, images: &[&Image], surface: &[f64], noise_j: f64) -> Self {
        let filter = MatchedFilter::new(camera);
        let (sigma, nx) = (camera.spot_sigma_m, camera.x.n);
        let of = |image: &&Image| {
            let above: Vec<f64> = (image.pixels.iter().zip(surface).zip(&image.weight))
                .map(|((v, s), w)| if *w > 0.0 { v - s - image.level } else { 0.0 })
                .collect();
            let peaks = filter.peaks(camera, &above, noise_j);
            let spots = detection::own_spots(&peaks, &[], |d| detection::unknown_halo(d / sigma));
            let at = |p: usize| {
                let mut sum = Halo::zeros();
                for spot in &spots {
                    let d = (camera.x.centre(p % nx) - spot.at[0]).hypot(camera.y.centre(p / nx) - spot.at[1]) / sigma;
                    if d < OUTSIDE {
                        return None;
                    }
                    sum += Halo::from_fn(|k, _| spot.energy_j * (d / OUTSIDE).powi(-FALLS[k]));
                }
                (image.weight[p] > 0.0).then_some(sum)
            };
            (0..above.len()).map(at).collect()
        };
        Self(images.par_iter().map(of).collect())
    }

    /// The share of each power by least squares, beside a surface that all images have and a level of each.
    fn halo(&self, images: &[&Image], terms: &Terms) -> Option<Halo> {
        let (mut information, mut vector) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros(), Row::zeros());
        for (image, halos) in images.iter().zip(&self.0) {
            let row = |(p, halo): (usize, &Option<Halo>)| {
                let surface = terms.0[p].fixed_rows::<TERMS>(1);
                halo.map(|halo| (Row::from_iterator(surface.iter().chain(&halo).copied()), p))
            };
            let rows: Vec<(Row, usize)> = halos.iter().enumerate().filter_map(row).collect();
            let mean = rows.iter().map(|(row, _)| row).sum::<Row>() / rows.len().max(1) as f64;
            for (row, p) in &rows {
                let row = row - mean;
                information += row * row.transpose();
                vector += row * (image.pixels[*p] - image.level);
            }
        }
        let scale = information.diagonal().map(|d| d.max(f64::MIN_POSITIVE).sqrt().recip());
        let mut scaled = information.component_mul(&(scale * scale.transpose()));
        (0..UNKNOWNS).for_each(|k| scaled[(k, k)] += RIDGE);
        let solution = scaled.cholesky()?.solve(&vector.component_mul(&scale));
        let halo = solution
            .component_mul(&scale)
            .fixed_rows::<{ FALLS.len() }>(TERMS)
            .into_owned();
        Some(halo)
    }

    /// Median of each pixel over the images in which it lies outside of spots, without their halos; not a number where there is none.
    fn middle(&self, images: &[&Image], halo: &Halo) -> Vec<f64> {
        let of = |p: usize| {
            let outside = images
                .iter()
                .zip(&self.0)
                .filter_map(|(image, halos)| halos[p].map(|own| image.pixels[p] - image.level - own.dot(halo)));
            median(outside.collect()).unwrap_or(f64::NAN)
        };
        (0..self.0.first().map_or(0, Vec::len)).map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images of a spot that moves and fades, its halo, and a surface.
    fn images(camera: &Camera, slope: f64, curvature: f64, halo: f64) -> Vec<Image> {
        let (ny, nx) = camera.shape();
        let sigma = camera.spot_sigma_m;
        let image = |k: usize| {
            let at = [0.3, 0.7].map(|step| 0.8 * ((k as f64 * step).sin()));
            let energy = 300.0 * (1.0 + 0.3 * (k as f64).cos());
            let pixel = |p: usize| {
                let [x, y] = [camera.x.centre(p % nx), camera.y.centre(p / nx)];
                let d = (x - at[0] * camera.x.half_width()).hypot(y - at[1] * camera.y.half_width()) / sigma;
                let spot = energy * ((-0.5 * d * d).exp() + halo / (1.0 + (d / 3.0).powi(2)));
                let (u, v) = (0.5 * x / camera.x.half_width(), 0.5 * y / camera.y.half_width());
                let noise = ((p * 7919 + k * 104_729) % 1009) as f64 / 1009.0 - 0.5;
                5.0 + slope * (u + 0.5 * v) + curvature * (u * u + v * v) + spot + 3.4 * noise
            };
            let pixels: Vec<f64> = (0..ny * nx).map(pixel).collect();
            Image {
                level: median(pixels.clone()).unwrap(),
                weight: vec![1.0; pixels.len()],
                pixels,
            }
        };
        (0..40).map(image).collect()
    }

    #[test]
    fn stray_light_is_what_does_not_come_and_go_with_the_spots() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let (ny, nx) = camera.shape();
        let middle = |images: &[Image]| -> Vec<f64> {
            let of = |p: usize| median(images.iter().map(|i| i.pixels[p] - i.level).collect()).unwrap();
            (0..ny * nx).map(of).collect()
        };
        let found = |slope: f64, curvature: f64, halo: f64| {
            let images = images(&camera, slope, curvature, halo);
            of(&camera, &images, &middle(&images), 1.0)
        };
        let halos = images(&camera, 0.0, 0.0, 0.2);
        assert!(Terms::new(&camera).surface(&middle(&halos), 1.0).is_some());
        assert_eq!(found(0.0, 0.0, 0.2), None);
        assert_eq!(found(0.0, 0.0, 0.0), None);
        for halo in [0.0, 0.2] {
            let sloped = found(8.0, 0.0, halo).expect("a slope of eight times the noise");
            let corner = sloped[0] - sloped[nx * ny - 1];
            assert!((corner + 12.0).abs() < 0.6, "{halo}: {corner}");
            let curved = found(0.0, -8.0, halo).expect("corners darker by four times the noise");
            let fall = curved[0] - curved[ny / 2 * nx + nx / 2];
            assert!((fall + 4.0).abs() < 0.6, "{halo}: {fall}");
        }
    }
}
