//! The lens's departure from a pinhole: principal point, focal scale, radial and tangential distortion
//! (Brown, 1966, "Decentering distortion of lenses"; the signs and names are those of OpenCV).

use serde::{Deserialize, Serialize};

/// x = c + z·s·(t·(1 + k1 r² + k2 r⁴ + k3 r⁶) + tangential), with t = (tan θx, tan θy) and r = ‖t‖.
/// Tangential, per axis: 2 p1 tx ty + p2 (r² + 2 tx²) and p1 (r² + 2 ty²) + 2 p2 tx ty.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// Where the optical axis meets the sensor, m.
    pub principal_point_m: [f64; 2],
    /// Factor on the lens-to-sensor distance z.
    pub focal_scale: f64,
    /// k1, k2, k3.
    pub radial: [f64; 3],
    /// p1, p2.
    pub tangential: [f64; 2],
}

impl Default for Distortion {
    fn default() -> Self {
        Self {
            principal_point_m: [0.0; 2],
            focal_scale: 1.0,
            radial: [0.0; 3],
            tangential: [0.0; 2],
        }
    }
}

impl Distortion {
    /// Number of parameters, in the order principal point, focal scale, k1, k2, k3, p1, p2.
    pub const PARAMETERS: usize = 8;

    /// Parameters in their fixed order.
    pub fn parameters(&self) -> [f64; Self::PARAMETERS] {
        let [cx, cy] = self.principal_point_m;
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        [cx, cy, self.focal_scale, k1, k2, k3, p1, p2]
    }

    /// The inverse of [`Distortion::parameters`].
    pub fn from_parameters([cx, cy, focal_scale, k1, k2, k3, p1, p2]: [f64; Self::PARAMETERS]) -> Self {
        Self {
            principal_point_m: [cx, cy],
            focal_scale,
            radial: [k1, k2, k3],
            tangential: [p1, p2],
        }
    }

    /// A pinhole needs no inversion.
    fn is_linear(&self) -> bool {
        self.radial == [0.0; 3] && self.tangential == [0.0; 2]
    }

    /// Sensor position, m, of the direction with tangents `t`, behind a lens at distance `z`.
    pub fn project(&self, z: f64, t: [f64; 2]) -> [f64; 2] {
        let bent = self.bend(t);
        let scale = z * self.focal_scale;
        std::array::from_fn(|k| self.principal_point_m[k] + scale * bent[k])
    }

    /// Tangents of the direction imaged at `sensor`, m: Newton's method on [`Distortion::project`]. Past the
    /// radius where the radial map folds back there is none, and the pinhole's answer is returned.
    pub fn unproject(&self, z: f64, sensor: [f64; 2]) -> [f64; 2] {
        let scale = z * self.focal_scale;
        let target: [f64; 2] = std::array::from_fn(|k| (sensor[k] - self.principal_point_m[k]) / scale);
        if self.is_linear() {
            return target;
        }
        let mut t = target;
        for _ in 0..30 {
            let bent = self.bend(t);
            let error = [bent[0] - target[0], bent[1] - target[1]];
            let [[a, b], [c, d]] = self.bend_jacobian(t);
            let det = a * d - b * c;
            if det <= 0.0 {
                return target;
            }
            let step = [(d * error[0] - b * error[1]) / det, (a * error[1] - c * error[0]) / det];
            t = [t[0] - step[0], t[1] - step[1]];
            if step[0].abs().max(step[1].abs()) < 1e-15 {
                return t;
            }
        }
        // Rounding may keep the last step just above the tolerance; a point that truly failed is far off.
        let bent = self.bend(t);
        let missed = (bent[0] - target[0]).hypot(bent[1] - target[1]);
        if missed < 1e-12 { t } else { target }
    }

    /// ∂x/∂t of [`Distortion::project`], m: rows are the sensor's axes.
    pub fn project_jacobian(&self, z: f64, t: [f64; 2]) -> [[f64; 2]; 2] {
        let scale = z * self.focal_scale;
        self.bend_jacobian(t).map(|row| row.map(|v| scale * v))
    }

    /// ∂x/∂parameters of [`Distortion::project`]: for each axis, one derivative a parameter.
    pub fn parameter_jacobian(&self, z: f64, t: [f64; 2]) -> [[f64; Self::PARAMETERS]; 2] {
        let scale = z * self.focal_scale;
        let bent = self.bend(t);
        let r2 = t[0] * t[0] + t[1] * t[1];
        let cross = 2.0 * t[0] * t[1];
        std::array::from_fn(|k| {
            let own = r2 + 2.0 * t[k] * t[k];
            let (p1, p2) = if k == 0 { (cross, own) } else { (own, cross) };
            let radial = scale * t[k] * r2;
            [
                if k == 0 { 1.0 } else { 0.0 },
                if k == 1 { 1.0 } else { 0.0 },
                z * bent[k],
                radial,
                radial * r2,
                radial * r2 * r2,
                scale * p1,
                scale * p2,
            ]
        })
    }

    /// Whether the map is one-to-one on all directions up to tangent radius `r_max`: the radial map grows
    /// everywhere and the tangential part does not undo it.
    pub fn is_invertible(&self, r_max: f64) -> bool {
        (0..=64).all(|i| {
            let r = r_max * i as f64 / 64.0;
            (0..16).all(|j| {
                let (sin, cos) = (j as f64 * std::f64::consts::PI / 8.0).sin_cos();
                let [[a, b], [c, d]] = self.bend_jacobian([r * cos, r * sin]);
                a * d - b * c > 0.0 && a + d > 0.0
            })
        })
    }

    fn bend(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    fn bend_jacobian(&self, [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2));
        let mixed = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
        [
            [radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x, mixed],
            [mixed, radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x],
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: Distortion = Distortion {
        principal_point_m: [2e-4, -3e-4],
        focal_scale: 1.01,
        radial: [0.1, -0.05, 0.02],
        tangential: [0.003, -0.002],
    };

    #[test]
    fn unproject_inverts_project() {
        for i in -5..=5 {
            for j in -5..=5 {
                let t = [i as f64 * 0.085, j as f64 * 0.085];
                let back = LENS.unproject(0.036, LENS.project(0.036, t));
                // A few units in the last place of tangents up to 0.6.
                assert!(
                    (back[0] - t[0]).abs() < 1e-14 && (back[1] - t[1]).abs() < 1e-14,
                    "{t:?} {back:?}"
                );
            }
        }
    }

    #[test]
    fn jacobians_agree_with_central_differences() {
        let (z, t, h) = (0.036, [0.31, -0.22], 1e-6);
        let by_t = LENS.project_jacobian(z, t);
        let by_p = LENS.parameter_jacobian(z, t);
        let close = |a: f64, b: f64| (a - b).abs() < 1e-9;
        for k in 0..2 {
            let shifted = |s: f64| std::array::from_fn(|i| t[i] + if i == k { s } else { 0.0 });
            let (up, down) = (LENS.project(z, shifted(h)), LENS.project(z, shifted(-h)));
            assert!((0..2).all(|a| close(by_t[a][k], (up[a] - down[a]) / (2.0 * h))));
        }
        for k in 0..Distortion::PARAMETERS {
            let at = |s: f64| {
                let mut p = LENS.parameters();
                p[k] += s;
                Distortion::from_parameters(p).project(z, t)
            };
            let (up, down) = (at(h), at(-h));
            assert!(
                (0..2).all(|a| close(by_p[a][k], (up[a] - down[a]) / (2.0 * h))),
                "parameter {k}"
            );
        }
    }

    #[test]
    fn a_map_that_folds_back_is_not_invertible() {
        assert!(LENS.is_invertible(0.65));
        let folded = Distortion {
            radial: [-1.5, 0.0, 0.0],
            ..Distortion::default()
        };
        assert!(!folded.is_invertible(0.65));
    }
}
