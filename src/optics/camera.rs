//! The camera: photodetector array, lens, and the maps between sensor and ground.

use std::sync::Arc;

use super::distortion::Distortion;
use super::pixel_maps::PixelMaps;
use super::spot::SpotShape;

/// One axis of the photodetector array: `n` pixels of equal pitch from `min_m` upwards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    pub n: usize,
    pub min_m: f64,
    pub pitch_m: f64,
}

impl Axis {
    /// `n` pixels over `size_m`, centred on the optical axis.
    pub fn centred(n: usize, size_m: f64) -> Self {
        Self {
            n,
            min_m: -0.5 * size_m,
            pitch_m: size_m / n as f64,
        }
    }

    /// Lower edge of pixel `k`, m; `edge(n)` is the sensor's upper edge.
    pub fn edge(&self, k: usize) -> f64 {
        self.min_m + k as f64 * self.pitch_m
    }

    /// Centre of pixel `k`, m.
    pub fn centre(&self, k: usize) -> f64 {
        self.min_m + (k as f64 + 0.5) * self.pitch_m
    }

    /// Half the sensor's width, m.
    pub fn half_width(&self) -> f64 {
        0.5 * self.n as f64 * self.pitch_m
    }
}

/// The monitoring camera: a lens at (0, 0, h_u) looking down and a PD array at distance z behind it.
#[derive(Clone, Debug)]
pub struct Camera {
    pub altitude_m: f64,
    pub lens_radius_m: f64,
    pub plane_distance_m: f64,
    pub x: Axis,
    pub y: Axis,
    /// σ_eff on the optical axis.
    pub spot_sigma_m: f64,
    /// Relative growth of σ_eff from the optical axis to the sensor's corner, with the square of the radius.
    pub spot_growth: f64,
    /// The spot as a calibration measured it; without one it is a Gaussian of σ_eff. With one, σ_eff is the width of the
    /// Gaussian nearest to it.
    pub spot_shape: Option<Arc<SpotShape>>,
    pub spot_error: SpotError,
    /// Standard deviation of the additive noise of one pixel.
    pub noise_std_j: f64,
    /// Growth of that noise's variance with a spot's light, J²/J, where a calibration measured it: the light's quantum q of shot noise.
    pub quantum_j: Option<f64>,
    pub joules_per_count: Option<f64>,
    pub saturation_j: Option<f64>,
    /// The lens's departure from a pinhole.
    pub distortion: Distortion,
    /// Per-pixel corrections that frames need before they are estimated.
    pub pixels: Option<Arc<PixelMaps>>,
}

/// Share of a spot's light by which its shape may differ from the model; where a learned shape ends, its [`Beyond`](super::spot::Beyond) counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SpotError {
    /// As the config says.
    Fixed(f64),
    /// As a calibration measured it, zero without one; more where the frames show more.
    AtLeast(f64),
}

impl SpotError {
    pub fn least(self) -> f64 {
        match self {
            Self::Fixed(share) | Self::AtLeast(share) => share,
        }
    }

    pub fn is_fixed(self) -> bool {
        matches!(self, Self::Fixed(_))
    }
}

impl Camera {
    /// Largest `spot_error`: beyond half of the light there is no model.
    pub const LARGEST_SPOT_ERROR: f64 = 0.5;

    /// A pixel at or above this, J, is saturated; infinite where no level is known.
    pub fn saturation_limit_j(&self) -> f64 {
        self.saturation_j.unwrap_or(f64::INFINITY)
    }

    /// Growth of the noise's variance with the light, both in units of the noise.
    pub fn quantum(&self) -> Option<f64> {
        Some(self.quantum_j? / self.noise_std_j)
    }

    /// Ground metres per sensor metre near the optical axis, h_u/z.
    pub fn ground_scale(&self) -> f64 {
        self.altitude_m / (self.plane_distance_m * self.distortion.focal_scale)
    }

    /// Ground position, m, of a sensor position, m: p̂ = h_u·(tan θ̂x, tan θ̂y), which is (h_u/z)·(x̂, ŷ) without
    /// distortion.
    pub fn to_ground(&self, sensor: [f64; 2]) -> [f64; 2] {
        self.distortion
            .unproject(self.plane_distance_m, sensor)
            .map(|t| t * self.altitude_m)
    }

    /// Sensor position, m, of a ground position, m: x = z·tan θx without distortion.
    pub fn to_sensor(&self, ground: [f64; 2]) -> [f64; 2] {
        self.distortion.project(self.plane_distance_m, self.tangents(ground))
    }

    /// (tan θx, tan θy) of a ground position, m.
    pub fn tangents(&self, ground: [f64; 2]) -> [f64; 2] {
        ground.map(|p| p / self.altitude_m)
    }

    /// σ_eff of a spot at a sensor position, m.
    pub fn spot_sigma_at(&self, sensor: [f64; 2]) -> f64 {
        self.spot_sigma_m * (1.0 + self.spot_growth * self.corner_ratio2(sensor))
    }

    /// Squared distance from the principal point over the squared half-diagonal of the sensor.
    pub fn corner_ratio2(&self, [x, y]: [f64; 2]) -> f64 {
        let [cx, cy] = self.distortion.principal_point_m;
        ((x - cx).powi(2) + (y - cy).powi(2)) / (self.x.half_width().powi(2) + self.y.half_width().powi(2))
    }

    /// Covariance on the ground, m², of a covariance on the sensor, m², at a sensor position, m: J C Jᵀ with
    /// J = ∂ground/∂sensor.
    pub fn cov_to_ground(&self, sensor: [f64; 2], cov: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        let tangents = self.distortion.unproject(self.plane_distance_m, sensor);
        let [[a, b], [c, d]] = self.distortion.project_jacobian(self.plane_distance_m, tangents);
        let scale = self.altitude_m / (a * d - b * c);
        let j = [[scale * d, -scale * b], [-scale * c, scale * a]];
        let half: [[f64; 2]; 2] = j.map(|row| std::array::from_fn(|k| row[0] * cov[0][k] + row[1] * cov[1][k]));
        let entry = |r: usize, k: usize| half[r][0] * j[k][0] + half[r][1] * j[k][1];
        // The two off-diagonal entries would be rounded apart.
        let off = entry(0, 1);
        [[entry(0, 0), off], [off, entry(1, 1)]]
    }

    /// The inverse of [`Camera::cov_to_ground`].
    pub fn cov_to_sensor(&self, sensor: [f64; 2], cov: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        let tangents = self.distortion.unproject(self.plane_distance_m, sensor);
        let jacobian = self.distortion.project_jacobian(self.plane_distance_m, tangents);
        let j = jacobian.map(|row| row.map(|v| v / self.altitude_m));
        let half: [[f64; 2]; 2] = j.map(|row| std::array::from_fn(|k| row[0] * cov[0][k] + row[1] * cov[1][k]));
        let entry = |r: usize, k: usize| half[r][0] * j[k][0] + half[r][1] * j[k][1];
        let off = entry(0, 1);
        [[entry(0, 0), off], [off, entry(1, 1)]]
    }

    /// Whether a ground position is imaged onto the array (`fov_limits`).
    pub fn sees(&self, ground: [f64; 2]) -> bool {
        let [x, y] = self.to_sensor(ground);
        x.abs() <= self.x.half_width() && y.abs() <= self.y.half_width()
    }

    /// Shape of a frame's pixels, (Ny, Nx).
    pub fn shape(&self) -> (usize, usize) {
        (self.y.n, self.x.n)
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn covariance_follows_the_jacobian_of_to_ground() {
        let mut camera = crate::optics::Config::default().camera().unwrap();
        camera.distortion.radial = [0.12, -0.03, 0.0];
        camera.distortion.tangential = [0.002, 0.001];
        camera.distortion.principal_point_m = [1e-4, 2e-4];
        let (at, h) = ([0.011, -0.007], 1e-7);
        let column = |k: usize| {
            let shifted = |s: f64| std::array::from_fn(|i| at[i] + if i == k { s } else { 0.0 });
            let (up, down) = (camera.to_ground(shifted(h)), camera.to_ground(shifted(-h)));
            [(up[0] - down[0]) / (2.0 * h), (up[1] - down[1]) / (2.0 * h)]
        };
        let (jx, jy) = (column(0), column(1));
        let cov = [[2.0, 0.5], [0.5, 1.0]];
        let got = camera.cov_to_ground(at, cov);
        for a in 0..2 {
            for b in 0..2 {
                let expected = 2.0 * jx[a] * jx[b] + 0.5 * (jx[a] * jy[b] + jy[a] * jx[b]) + jy[a] * jy[b];
                // Central differences of step h lose about half the digits.
                assert!((got[a][b] - expected).abs() < 1e-6 * got[0][0], "{got:?}");
            }
        }
    }
}
