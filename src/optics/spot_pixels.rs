//! What the pixels collect of a spot, whatever its shape.

use std::ops::Range;

use super::camera::{Axis, Camera};
use super::psf;

/// Adds a spot of energy `energy_j`, J, at `sensor_m`, m, to `pixels`, J, row by row as [`Camera::shape`] says: the measured shape
/// where the camera has one, a Gaussian of σ_eff otherwise.
pub fn add_spot(camera: &Camera, sensor_m: [f64; 2], energy_j: f64, pixels: &mut [f64]) {
    let (mut row, mut column) = (vec![0.0; camera.x.n], vec![0.0; camera.y.n]);
    let Some(shape) = &camera.spot_shape else {
        let sigma = camera.spot_sigma_at(sensor_m);
        psf::profile(&camera.x, sensor_m[0], sigma, &mut row);
        psf::profile(&camera.y, sensor_m[1], sigma, &mut column);
        add(
            energy_j,
            (0..row.len(), &row),
            (0..column.len(), &column),
            pixels,
            camera.x.n,
        );
        return;
    };
    let columns = within(&camera.x, sensor_m[0], shape.radius_m());
    let rows = within(&camera.y, sensor_m[1], shape.radius_m());
    for (k, (weight, ..)) in shape.weights_at(sensor_m[0], sensor_m[1]).enumerate() {
        let (a, b) = (shape.x_profile(k), shape.y_profile(k));
        let collected = |axis: &Axis, at: f64, pixel: usize, profile: &super::spot::Profile| {
            profile.cumulative(axis.edge(pixel + 1) - at) - profile.cumulative(axis.edge(pixel) - at)
        };
        for pixel in columns.clone() {
            row[pixel] = collected(&camera.x, sensor_m[0], pixel, a);
        }
        for pixel in rows.clone() {
            column[pixel] = collected(&camera.y, sensor_m[1], pixel, b);
        }
        add(
            weight * energy_j,
            (columns.clone(), &row),
            (rows.clone(), &column),
            pixels,
            camera.x.n,
        );
    }
}

/// Pixels along one axis that reach within `radius_m` of a place.
fn within(axis: &Axis, at: f64, radius_m: f64) -> Range<usize> {
    let pixel = |x: f64| ((x - axis.min_m) / axis.pitch_m).clamp(0.0, axis.n as f64);
    let first = pixel(at - radius_m).floor() as usize;
    first..(pixel(at + radius_m).ceil() as usize).max(first)
}

fn add(scale: f64, x: (Range<usize>, &[f64]), y: (Range<usize>, &[f64]), pixels: &mut [f64], nx: usize) {
    for j in y.0 {
        let line = &mut pixels[j * nx + x.0.start..j * nx + x.0.end];
        for (pixel, fraction) in line.iter_mut().zip(&x.1[x.0.clone()]) {
            *pixel += scale * y.1[j] * fraction;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::optics::Config;
    use crate::optics::spot::{Field, SpotShape, Template};

    #[test]
    fn a_gaussian_as_a_shape_gives_the_pixels_of_a_gaussian() {
        let camera = Config::default().camera().unwrap();
        let sigma = camera.spot_sigma_m;
        let field = Field {
            half_sensor_m: [camera.x.half_width(), camera.y.half_width()],
        };
        let density = |x: f64, y: f64| (-0.5 * (x * x + y * y) / (sigma * sigma)).exp();
        let template = Template::of_density(field, 0.1 * sigma, 7.0 * sigma, density);
        let shape = SpotShape::from_template(&template, 1e-6).unwrap();
        assert_eq!(shape.terms(), 1);
        // Splines of order h⁴ with h = σ/10.
        assert!((shape.sigma_equivalent_m() / sigma - 1.0).abs() < 1e-5);
        assert!((shape.encircled_energy([0.0; 2], 2.0 * sigma) - (1.0 - (-2.0_f64).exp())).abs() < 1e-5);
        let shaped = Camera {
            spot_shape: Some(Arc::new(shape)),
            ..camera.clone()
        };
        for at in [[0.0, 0.0], [0.0031, -0.0127], [-0.0152, 0.0149]] {
            let (mut expected, mut got) = (vec![0.0; 64 * 64], vec![0.0; 64 * 64]);
            add_spot(&camera, at, 2.0, &mut expected);
            add_spot(&shaped, at, 2.0, &mut got);
            let worst = expected
                .iter()
                .zip(&got)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max);
            assert!(worst < 1e-5, "{at:?}: {worst}");
        }
    }
}
