use nalgebra::{Matrix2, Vector2};

use crate::estimate::{Estimate, Flags};
use crate::monitor::stats::second_moment::SecondMomentScore;
use crate::optics::Camera;

/// What a fit's covariance leaves out (calibration, pixel gains), m.
const POSITION_FLOOR_M: f64 = 0.02;

/// One frame's emitter as the tracks take it.
#[derive(Clone, Debug)]
pub struct Detection {
    pub position: Vector2<f64>,
    pub cov: Matrix2<f64>,
    pub energy_j: f64,
    pub flags: Flags,
    pub moments: SecondMomentScore,
    /// Signal-to-noise ratio, less what the frame's misfit takes from it.
    pub snr: f64,
    /// Distance within which a second emitter of like energy cannot be told apart, m.
    pub resolution_m: f64,
    /// How probable a spurious detection is here in a frame.
    pub clutter_probability: f64,
}

impl Detection {
    /// The emitters of an estimate on the ground, with what is known of how far each can be trusted.
    pub fn of(estimate: &Estimate, camera: &Camera) -> Vec<Self> {
        // A frame that the model explains badly has errors beyond its covariances.
        let inflation = if estimate.reduced_chi2.is_finite() {
            estimate.reduced_chi2.clamp(1.0, 100.0)
        } else {
            100.0
        };
        let usable = |e: &&crate::estimate::Emitter| {
            e.x_m.is_finite() && e.y_m.is_finite() && e.cov_m2.iter().flatten().all(|c| c.is_finite())
        };
        let mut detections: Vec<Self> = estimate
            .emitters
            .iter()
            .filter(usable)
            .map(|e| {
                let [[a, b], [_, c]] = e.cov_m2;
                let (a, c) = (a.max(0.0), c.max(0.0));
                // No correlation beyond ±1, whatever a learned estimator claims.
                let most = a.sqrt() * c.sqrt();
                let b = b.clamp(-most, most);
                let cov = Matrix2::new(a, b, b, c) * inflation + Matrix2::identity() * POSITION_FLOOR_M.powi(2);
                Self {
                    position: Vector2::new(e.x_m, e.y_m),
                    cov,
                    energy_j: e.energy_j,
                    flags: e.flags,
                    moments: SecondMomentScore::of(&e.second_moment, inflation),
                    snr: snr(camera, e.energy_j) / inflation.sqrt(),
                    resolution_m: resolution_m(camera, snr(camera, e.energy_j)),
                    clutter_probability: 0.0,
                }
            })
            .collect();
        for i in 0..detections.len() {
            detections[i].clutter_probability = clutter_probability(&detections, i, camera);
        }
        detections
    }

    /// What this and `others` are as one spot: all the light, its centre, and the second moments about it. A fit says it of one
    /// emitter where it found one; where it found several in a spot, their number is nearly chance.
    pub fn united<'a>(&'a self, others: impl Iterator<Item = &'a Self> + Clone, camera: &Camera) -> Self {
        let all = || std::iter::once(self).chain(others.clone());
        let energy_j: f64 = all().map(|d| d.energy_j).sum();
        if others.clone().next().is_none() || !(energy_j > 0.0) {
            return self.clone();
        }
        let position = all()
            .map(|d| d.position * (d.energy_j / energy_j))
            .sum::<Vector2<f64>>();
        let spot_m = camera.spot_sigma_m * camera.ground_scale();
        let spread = all().map(|d| {
            let off = (d.position - position) / spot_m;
            off * off.transpose() * (d.energy_j / energy_j)
        });
        let snr: f64 = all().map(|d| d.snr).sum();
        let variance = 2.0 * (spot_m / snr).powi(2) + POSITION_FLOOR_M.powi(2);
        Self {
            position,
            cov: Matrix2::identity() * variance,
            energy_j,
            moments: SecondMomentScore::of_spread(spread.sum(), snr),
            snr,
            ..self.clone()
        }
    }

    /// Of either beam's position, when two share the spot.
    pub fn shared_cov(&self) -> Matrix2<f64> {
        self.cov + Matrix2::identity() * self.resolution_m.powi(2)
    }
}

/// Signal-to-noise ratio of the matched filter for a spot wider than a pixel: A·pitch/(2√π·σ·σ_n).
pub fn snr(camera: &Camera, energy_j: f64) -> f64 {
    let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
    let spread = 2.0 * std::f64::consts::PI.sqrt() * camera.spot_sigma_m;
    energy_j.max(0.0) * pitch / (spread * camera.noise_std_j)
}

/// An equal pair can be told apart at d ≥ 5 σ/√SNR (measured on the fit); never taken beyond 3 σ, where any two spots show two
/// maxima.
fn resolution_m(camera: &Camera, snr: f64) -> f64 {
    let sigma = camera.spot_sigma_m;
    let apart = 5.0 * sigma / snr.max(1e-3).sqrt();
    let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
    apart.max(0.5 * pitch).min(3.0 * sigma) * camera.ground_scale()
}

/// How probable it is that detection `i` is spurious: rare on its own, common where one spot may have been split in two.
/// Even there it is no excuse for silence: nine detections in ten frames outweigh it, so that nobody gains more than a second
/// by making the fit doubtful.
fn clutter_probability(detections: &[Detection], i: usize, camera: &Camera) -> f64 {
    const ALONE: f64 = 1e-3;
    const NEIGHBOURED: f64 = 1e-2;
    const POORLY_FITTED: f64 = 0.03;
    const UNRESOLVED: f64 = 0.1;
    let d = &detections[i];
    let nearest = (0..detections.len())
        .filter(|&j| j != i)
        .map(|j| (detections[j].position - d.position).norm())
        .fold(f64::INFINITY, f64::min);
    if d.flags.contains(Flags::UNRESOLVED) || nearest < d.resolution_m {
        UNRESOLVED
    } else if d
        .flags
        .intersects(Flags::NO_CONVERGENCE | Flags::POOR_FIT | Flags::ILL_CONDITIONED)
    {
        POORLY_FITTED
    } else if nearest < 3.0 * camera.spot_sigma_m * camera.ground_scale() {
        NEIGHBOURED
    } else {
        ALONE
    }
}
