//! The variance of a pixel's noise as a function of its expected light.

/// Largest share of a pixel's noise that a fit is taken to have absorbed (a bright spot of one pixel would divide by zero), and Fisher
/// scoring steps of the fit, which converges quadratically.
const LEVERAGE: f64 = 0.6;
const SCORING: usize = 8;

/// Variance of a pixel's noise in units of the configured variance: c + a s + b s², s the expected light in units of the noise. a is
/// shot noise, b gain scatter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct VarianceFunction {
    pub floor: f64,
    pub linear: f64,
    pub square: f64,
}

impl Default for VarianceFunction {
    fn default() -> Self {
        Self {
            floor: 1.0,
            linear: 0.0,
            square: 0.0,
        }
    }
}

impl VarianceFunction {
    /// Least gain in −2 ln likelihood for which the noise is taken to depend on the light.
    pub const PENALTY: f64 = 10.0;

    /// Shot noise of light whose quantum is `quantum` in units of the noise.
    pub fn of_quantum(quantum: f64) -> Self {
        Self {
            linear: quantum,
            ..Self::default()
        }
    }

    pub fn at(self, signal: f64) -> f64 {
        let s = signal.max(0.0);
        self.floor + s * (self.linear + s * self.square)
    }

    /// Maximum-likelihood fit to the residual of a model of `sources` emitters (Fisher scoring for a variance that is linear in
    /// its parameters), shot noise or gain scatter, whichever explains more. `residual` and `signal` are rows of `nx` pixels,
    /// `stride` numbers apart.
    pub fn fit(is_masked: &[bool], [nx, stride]: [usize; 2], residual: &[f64], signal: &[f64], sources: usize) -> Self {
        let total: f64 = signal.iter().map(|s| s.max(0.0)).sum();
        let brightest = signal.iter().fold(0.0, |a: f64, &s| a.max(s));
        let mut points = Vec::with_capacity(is_masked.len());
        for (k, _) in is_masked.iter().enumerate().filter(|(_, bad)| !**bad) {
            let at = k / nx * stride + k % nx;
            let s = signal[at].max(0.0);
            // The share of the noise that the fit's own parameters absorb there.
            let leverage = if total > 0.0 {
                (3.0 * sources as f64 * s / total).min(LEVERAGE)
            } else {
                0.0
            };
            points.push((s, residual[at].powi(2) / (1.0 - leverage)));
        }
        let cost = |g: &Self| points.iter().map(|&(s, r)| g.at(s).ln() + r / g.at(s)).sum::<f64>();
        let mut best = (Self::default(), cost(&Self::default()));
        if brightest <= 0.0 {
            return best.0;
        }
        for power in [1, 2] {
            let (mut c, mut k) = (1.0, 0.0);
            for _ in 0..SCORING {
                let mut n = [0.0; 5];
                for &(s, r) in &points {
                    let x = (s / brightest).powi(power);
                    let w = (c + k * x).powi(-2);
                    n[0] += w;
                    n[1] += w * x;
                    n[2] += w * x * x;
                    n[3] += w * r;
                    n[4] += w * x * r;
                }
                let det = n[0] * n[2] - n[1] * n[1];
                let slope = if det > 1e-9 * n[0] * n[2] {
                    (n[0] * n[4] - n[1] * n[3]) / det
                } else {
                    0.0
                };
                k = slope.max(0.0);
                c = ((n[3] - k * n[1]) / n[0]).max(1.0);
            }
            let slope = k / brightest.powi(power);
            let found = Self {
                floor: c,
                linear: if power == 1 { slope } else { 0.0 },
                square: if power == 2 { slope } else { 0.0 },
            };
            let cost = cost(&found);
            if cost < best.1 {
                best = (found, cost);
            }
        }
        best.0
    }

    pub fn is_constant(self) -> bool {
        self == Self::default()
    }
}
