//! The blur budget of the sensor plane.

/// Standard deviation of the Gaussian that best fits the Airy core, in units of λf/D
/// (Zhang, Zerubia and Olivo-Marin, 2007, "Gaussian approximations of fluorescence microscope PSF models").
const AIRY_GAUSSIAN: f64 = 0.42;

/// σ_eff, m, on a plane at `z` behind a lens of radius `r_a` and focal length `f`:
/// σ_eff² = d_geo²/16 + ((z/f)·0.42·λf/D)² + σ_sens², d_geo = 2 r_a |1 − z/f|. Valid for 0 < z ≤ f.
pub fn spot_sigma(r_a: f64, z: f64, f: f64, wavelength: f64, sensor_sigma: f64) -> f64 {
    let geometric = 2.0 * r_a * (1.0 - z / f).abs() / 4.0;
    let diffraction = (z / f) * AIRY_GAUSSIAN * wavelength * f / (2.0 * r_a);
    geometric.hypot(diffraction).hypot(sensor_sigma)
}
