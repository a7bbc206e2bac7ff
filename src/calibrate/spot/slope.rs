//! A background that rises across the sensor, the same in all frames: stray light. Spots are looked for on a level one.

use nalgebra::{Matrix3, Vector3};

use crate::optics::Camera;
use crate::stats::median;

/// Rounds of reweighting, and the distance, in median deviations, at which a pixel's weight is a half (Cauchy): spots that stand still are
/// in every frame.
const ROUNDS: usize = 20;
const HALF_WEIGHT: f64 = 2.0;
/// Share of the median deviation that a plane may leave: light of spots is no plane.
const LEAVES: f64 = 0.5;

/// The plane through the median of each pixel, (Ny, Nx) row by row, J, zero in its middle; `None` where none shows beyond a pixel's noise.
pub fn of(camera: &Camera, middle: &[f64], noise_j: f64) -> Option<Vec<f64>> {
    let (ny, nx) = camera.shape();
    let along = |k: usize, n: usize| 2.0 * (k as f64 + 0.5) / n as f64 - 1.0;
    let rows: Vec<Vector3<f64>> = (0..ny * nx)
        .map(|p| Vector3::new(1.0, along(p % nx, nx), along(p / nx, ny)))
        .collect();
    let deviation = |plane: &Vector3<f64>| -> Vec<f64> {
        let pixels = middle.iter().zip(&rows);
        pixels.map(|(v, row)| (v - row.dot(plane)).abs()).collect()
    };
    let level = Vector3::new(median(middle.to_vec())?, 0.0, 0.0);
    let before = median(deviation(&level))?;
    let (mut plane, mut scale) = (level, before);
    for _ in 0..ROUNDS {
        let (mut information, mut vector) = (Matrix3::zeros(), Vector3::zeros());
        for ((row, v), off) in rows.iter().zip(middle).zip(deviation(&plane)) {
            let weight = 1.0 / (1.0 + (off / (HALF_WEIGHT * scale).max(f64::MIN_POSITIVE)).powi(2));
            information += row * row.transpose() * weight;
            vector += row * *v * weight;
        }
        plane = information.cholesky()?.solve(&vector);
        scale = median(deviation(&plane))?;
    }
    let is_seen = 2.0 * plane.y.hypot(plane.z) > noise_j && scale < LEAVES * before;
    is_seen.then(|| rows.iter().map(|row| row.y * plane.y + row.z * plane.z).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_found_beside_spots_and_none_where_there_is_none() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let (ny, nx) = camera.shape();
        let image = |slope: f64| -> Vec<f64> {
            let pixel = |p: usize| {
                let (x, y) = ((p % nx) as f64 / nx as f64 - 0.5, (p / nx) as f64 / ny as f64 - 0.5);
                let spot = 30.0 * (-0.5 * ((x - 0.3).powi(2) + (y - 0.2).powi(2)) / 0.003).exp();
                5.0 + slope * (x + 0.5 * y) + spot + 0.05 * ((p * 7919 % 100) as f64 - 50.0) / 50.0
            };
            (0..ny * nx).map(pixel).collect()
        };
        assert_eq!(of(&camera, &image(0.0), 1.0), None);
        let found = of(&camera, &image(8.0), 1.0).expect("a slope of eight times the noise");
        let corner = found[0] - found[nx * ny - 1];
        assert!((corner + 12.0).abs() < 0.5, "{corner}");
    }
}
