//! A background that rises or is curved across the sensor, the same in all frames: stray light, or daylight through a lens that is darker at its
//! edge. Spots are looked for on a level one.

use nalgebra::{Matrix6, Vector6};

use crate::optics::Camera;
use crate::stats::median;

/// Rounds of reweighting, and the distance, in median deviations, at which a pixel's weight is a half (Cauchy): spots that stand still are
/// in every frame.
const ROUNDS: usize = 20;
const HALF_WEIGHT: f64 = 2.0;
/// Share of the median deviation that a surface may leave: light of spots is none.
const LEAVES: f64 = 0.5;
/// Widths of a spot within which an array holds nothing but halos: their light over its mean falls as the array grows, an Airy disc's with the
/// distance. Larger leaves faint stray light beside bright spots, smaller takes rings for it.
const HALO: f64 = 10.0;

/// The quadratic surface through the median of each pixel, (Ny, Nx) row by row, J, zero in its middle; `None` where none shows beyond a pixel's
/// noise and what halos of spots of `light_j` a pixel may be.
pub fn of(camera: &Camera, middle: &[f64], noise_j: f64, light_j: f64) -> Option<Vec<f64>> {
    let (ny, nx) = camera.shape();
    let along = |k: usize, n: usize| 2.0 * (k as f64 + 0.5) / n as f64 - 1.0;
    let row = |x: f64, y: f64| Vector6::new(1.0, x, y, 1.5 * x * x - 0.5, x * y, 1.5 * y * y - 0.5);
    let rows: Vec<Vector6<f64>> = (0..ny * nx)
        .map(|p| row(along(p % nx, nx), along(p / nx, ny)))
        .collect();
    let deviation = |surface: &Vector6<f64>| -> Vec<f64> {
        let pixels = middle.iter().zip(&rows);
        pixels.map(|(v, row)| (v - row.dot(surface)).abs()).collect()
    };
    let mut surface = Vector6::zeros();
    surface[0] = median(middle.to_vec())?;
    let before = median(deviation(&surface))?;
    let mut scale = before;
    for _ in 0..ROUNDS {
        let (mut information, mut vector) = (Matrix6::zeros(), Vector6::zeros());
        for ((row, v), off) in rows.iter().zip(middle).zip(deviation(&surface)) {
            let weight = 1.0 / (1.0 + (off / (HALF_WEIGHT * scale).max(f64::MIN_POSITIVE)).powi(2));
            information += row * row.transpose() * weight;
            vector += row * *v * weight;
        }
        surface = information.cholesky()?.solve(&vector);
        scale = median(deviation(&surface))?;
    }
    let level = row(0.0, 0.0).dot(&surface);
    let rises: Vec<f64> = rows.iter().map(|row| row.dot(&surface) - level).collect();
    let [low, high] = [f64::min, f64::max].map(|of| rises.iter().copied().fold(0.0, of));
    let extent_m = camera.x.half_width().min(camera.y.half_width()) * 2.0;
    let halos_j = light_j * HALO * camera.spot_sigma_m / extent_m;
    (high - low > noise_j.max(halos_j) && scale < LEAVES * before).then_some(rises)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stray_light_is_found_beside_spots_and_none_where_there_is_none() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let (ny, nx) = camera.shape();
        let image = |slope: f64, curvature: f64| -> Vec<f64> {
            let pixel = |p: usize| {
                let (x, y) = ((p % nx) as f64 / nx as f64 - 0.5, (p / nx) as f64 / ny as f64 - 0.5);
                let spot = 30.0 * (-0.5 * ((x - 0.3).powi(2) + (y - 0.2).powi(2)) / 0.003).exp();
                5.0 + slope * (x + 0.5 * y)
                    + curvature * (x * x + y * y)
                    + spot
                    + 0.05 * ((p * 7919 % 100) as f64 - 50.0) / 50.0
            };
            (0..ny * nx).map(pixel).collect()
        };
        assert_eq!(of(&camera, &image(0.0, 0.0), 1.0, 0.0), None);
        assert_eq!(of(&camera, &image(8.0, 0.0), 1.0, 50.0), None);
        let found = of(&camera, &image(8.0, 0.0), 1.0, 1.0).expect("a slope of eight times the noise");
        let corner = found[0] - found[nx * ny - 1];
        assert!((corner + 12.0).abs() < 0.5, "{corner}");
        let found = of(&camera, &image(0.0, -8.0), 1.0, 1.0).expect("corners darker by four times the noise");
        let fall = found[0] - found[ny / 2 * nx + nx / 2];
        assert!((fall + 4.0).abs() < 0.3, "{fall}");
    }
}
