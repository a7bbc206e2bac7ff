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
    /// σ_eff.
    pub spot_sigma_m: f64,
    /// Standard deviation of the additive noise of one pixel.
    pub noise_std_j: f64,
    pub joules_per_count: Option<f64>,
    pub saturation_j: Option<f64>,
}

impl Camera {
    /// Ground metres per sensor metre, h_u/z.
    pub fn ground_scale(&self) -> f64 {
        self.altitude_m / self.plane_distance_m
    }

    /// Ground position, m, of a sensor position, m: p̂ = (h_u/z)·(x̂, ŷ).
    pub fn to_ground(&self, sensor: [f64; 2]) -> [f64; 2] {
        sensor.map(|s| s * self.ground_scale())
    }

    /// Sensor position, m, of a ground position, m: x = z·tan θx.
    pub fn to_sensor(&self, ground: [f64; 2]) -> [f64; 2] {
        ground.map(|p| p / self.ground_scale())
    }

    /// Covariance on the ground, m², of a covariance on the sensor, m².
    pub fn cov_to_ground(&self, _sensor: [f64; 2], cov: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        let g2 = self.ground_scale().powi(2);
        cov.map(|row| row.map(|c| c * g2))
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
