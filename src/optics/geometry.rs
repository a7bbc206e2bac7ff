//! Angles, sensor, ground: the pinhole map of a lens at (0, 0, h_u) that looks straight down.
//!
//! Lengths in m, angles in rad. Ground coordinates lie in the plane z = 0 with the origin at the UAV's nadir. An angle
//! pair (θx, θy) is that of the ray's projections onto the x–z and y–z planes.

/// Sensor position of a ray: x = z·tan θx (`map_general`).
pub fn sensor_from_angles(plane_distance_m: f64, angles: [f64; 2]) -> [f64; 2] {
    angles.map(|t| plane_distance_m * t.tan())
}

/// The ray that meets the sensor at a position: θx = arctan(x/z).
pub fn angles_from_sensor(plane_distance_m: f64, sensor: [f64; 2]) -> [f64; 2] {
    sensor.map(|s| s.atan2(plane_distance_m))
}

/// Ground position of a ray: p = h_u·(tan θx, tan θy) (`inverse_geo_final`).
pub fn ground_from_angles(altitude_m: f64, angles: [f64; 2]) -> [f64; 2] {
    angles.map(|t| altitude_m * t.tan())
}

/// The ray from a ground position to the lens: θx = arctan(x/h_u).
pub fn angles_from_ground(altitude_m: f64, ground: [f64; 2]) -> [f64; 2] {
    ground.map(|p| p.atan2(altitude_m))
}

/// Largest |θ| that still meets the sensor: arctan(X_max/z) (`fov_limits`).
pub fn half_field_of_view(half_width_m: f64, plane_distance_m: f64) -> f64 {
    half_width_m.atan2(plane_distance_m)
}

/// Distance L from a ground emitter to the lens: h_u·√(1 + tan²θx + tan²θy).
pub fn link_length(altitude_m: f64, ground: [f64; 2]) -> f64 {
    altitude_m.hypot(ground[0].hypot(ground[1]))
}

/// Cosine of the angle between a ground emitter's beam and the lens's axis: h_u/L, exact at any angle.
/// The paper's θ = √(θx² + θy²) is its small-angle form.
pub fn incidence_cos(altitude_m: f64, ground: [f64; 2]) -> f64 {
    altitude_m / link_length(altitude_m, ground)
}

#[cfg(test)]
mod tests {
    use super::*;

    const H: f64 = 300.0;
    const Z: f64 = 0.036;

    #[test]
    fn the_papers_area_fills_the_papers_sensor() {
        let edge = ground_from_angles(H, [half_field_of_view(0.015, Z), 0.0]);
        assert!((edge[0] - 125.0).abs() < 1e-10);
    }

    #[test]
    fn maps_are_inverse_to_each_other_up_to_grazing_angles() {
        for p in [0.0, 1e-9, -8.3, 125.0, -3e4, 1e9] {
            let ground = [p, -0.5 * p];
            let angles = angles_from_ground(H, ground);
            let back = ground_from_angles(H, angles_from_sensor(Z, sensor_from_angles(Z, angles)));
            // A rounding of θ moves tan θ by (1 + tan²θ): that much of the relative precision is lost near grazing.
            let allowed = 8.0 * f64::EPSILON * (1.0 + (p / H).abs()) * p.abs();
            assert!((back[0] - p).abs() <= allowed, "{p}: {back:?}");
        }
    }

    #[test]
    fn length_and_incidence_agree_with_the_ray() {
        let ground = [120.0, -50.0];
        let [tx, ty] = angles_from_ground(H, ground).map(f64::tan);
        let length = H * (1.0 + tx * tx + ty * ty).sqrt();
        assert!((link_length(H, ground) - length).abs() < 1e-12 * length);
        assert!((incidence_cos(H, ground) - H / length).abs() < 1e-15);
        assert_eq!(incidence_cos(H, [0.0, 0.0]), 1.0);
    }
}
