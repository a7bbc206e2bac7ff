//! One frame's emitters as the tracker takes them: position, covariance and the probability that each is clutter.

use nalgebra::{Matrix2, Matrix2x6, Vector2};

use crate::estimate::{Emitter, Estimate, Flags};
use crate::geo::View;
use crate::monitor::stats::moment_score::MomentScore;
use crate::optics::Camera;

/// Standard deviation that a fit's covariance leaves out (calibration, pixel gains), m. Larger loosens every gate, smaller makes
/// exact fits miss theirs. Not measured.
const POSITION_FLOOR_M: f64 = 0.02;
/// Largest factor on covariances for a frame's misfit: beyond it the reduced χ² says only that the model is wrong.
const MAX_INFLATION: f64 = 100.0;
/// Distance, in σ of the spot, within which two spots overlap by a tenth.
pub const OVERLAP: f64 = 3.0;

/// What earlier frames have given of a detection, where the estimator follows emitters over frames.
#[derive(Clone, Copy, Debug)]
pub enum Earlier {
    Nothing,
    /// All: position and covariance are the posterior of all frames, and so is the velocity, m/s.
    All {
        velocity: Vector2<f64>,
    },
    /// The error of covariance `cov`, m², that is its own: the pose's is the frame's.
    Own {
        cov: Matrix2<f64>,
    },
}

/// An emitter of one frame on the ground.
#[derive(Clone, Debug)]
pub struct Detection {
    pub position: Vector2<f64>,
    /// Height of the ground there above the world's origin, m.
    pub z_m: f64,
    pub cov: Matrix2<f64>,
    /// ∂position/∂pose; zero for a fixed platform.
    pub by_pose: Matrix2x6<f64>,
    pub earlier: Earlier,
    pub energy_j: f64,
    pub flags: Flags,
    pub moments: MomentScore,
    /// Signal-to-noise ratio, less what the frame's misfit takes from it.
    pub snr: f64,
    /// Distance within which a second emitter of like energy cannot be resolved, m.
    pub resolution_m: f64,
    /// Probability of a spurious detection here in a frame.
    pub clutter_probability: f64,
}

impl Detection {
    /// The emitters of an estimate whose position and covariance are finite, each with its clutter probability; their energies times
    /// `energy_scale`.
    pub fn of(estimate: &Estimate, energy_scale: f64, view: &View) -> Vec<Self> {
        // A frame that the model explains badly has errors beyond its covariances.
        let inflation = if estimate.reduced_chi2.is_finite() {
            estimate.reduced_chi2.clamp(1.0, MAX_INFLATION)
        } else {
            MAX_INFLATION
        };
        let is_finite =
            |e: &&Emitter| e.x_m.is_finite() && e.y_m.is_finite() && e.cov_m2.iter().flatten().all(|c| c.is_finite());
        let mut detections: Vec<Self> = estimate
            .emitters
            .iter()
            .filter(is_finite)
            .filter_map(|e| Self::of_emitter(e, inflation, view))
            .collect();
        for detection in &mut detections {
            detection.energy_j *= energy_scale;
        }
        for i in 0..detections.len() {
            detections[i].clutter_probability = clutter_probability(&detections, i, view);
        }
        detections
    }

    /// `None` where the emitter's ray meets no ground that is known.
    fn of_emitter(e: &Emitter, inflation: f64, view: &View) -> Option<Self> {
        let camera = &view.camera;
        let placed = view.place(e.sensor_m, [e.x_m, e.y_m], e.cov_m2)?;
        let [[a, b], [_, c]] = placed.cov_m2;
        let (a, c) = (a.max(0.0), c.max(0.0));
        // No correlation beyond ±1, whatever a learned estimator states.
        let most = a.sqrt() * c.sqrt();
        let b = b.clamp(-most, most);
        let cov = Matrix2::new(a, b, b, c) * inflation + Matrix2::identity() * POSITION_FLOOR_M.powi(2);
        let earlier = match (e.lasting_cov_m2, e.velocity) {
            (Some([x, y]), _) => Earlier::Own {
                cov: Matrix2::from_rows(&[x.into(), y.into()]) * inflation,
            },
            (None, Some(v)) => Earlier::All {
                velocity: Vector2::new(v.vx_m_s, v.vy_m_s),
            },
            (None, None) => Earlier::Nothing,
        };
        Some(Self {
            position: placed.position_m,
            z_m: placed.z_m,
            cov,
            by_pose: placed.by_pose,
            earlier,
            energy_j: e.energy_j,
            flags: e.flags,
            moments: MomentScore::of(&e.second_moment, inflation),
            snr: snr(camera, e.energy_j) / inflation.sqrt(),
            resolution_m: resolution_m(view, snr(camera, e.energy_j)),
            clutter_probability: 0.0,
        })
    }

    /// This and `others` as one spot: all the light, its centre, and the second moments about it. A fit gives this of one
    /// emitter where it found one; where it found several in a spot, their number is nearly chance.
    pub fn united<'a>(&'a self, others: impl Iterator<Item = &'a Self> + Clone, view: &View) -> Self {
        let all = || std::iter::once(self).chain(others.clone());
        let energy_j: f64 = all().map(|d| d.energy_j).sum();
        if others.clone().next().is_none() || !(energy_j > 0.0) {
            return self.clone();
        }
        let position = all()
            .map(|d| d.position * (d.energy_j / energy_j))
            .sum::<Vector2<f64>>();
        let spot_m = spot_m(view);
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
            moments: MomentScore::of_spread(spread.sum(), snr),
            snr,
            ..self.clone()
        }
    }

    /// Covariance of either beam's position when two share the spot.
    pub fn merged_cov(&self) -> Matrix2<f64> {
        self.cov + Matrix2::identity() * self.resolution_m.powi(2)
    }
}

/// σ of a spot on the ground, m.
pub fn spot_m(view: &View) -> f64 {
    view.camera.spot_sigma_m * view.ground_scale()
}

/// Area of the view on the ground, m².
pub fn view_m2(view: &View) -> f64 {
    let [width, height] = [&view.camera.x, &view.camera.y].map(|axis| 2.0 * axis.half_width() * view.ground_scale());
    width * height
}

/// Signal-to-noise ratio of the matched filter for a spot wider than a pixel: A·pitch/(2√π·σ·σ_n).
pub fn snr(camera: &Camera, energy_j: f64) -> f64 {
    let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
    let spread = 2.0 * std::f64::consts::PI.sqrt() * camera.spot_sigma_m;
    energy_j.max(0.0) * pitch / (spread * camera.noise_std_j)
}

/// An equal pair is resolved at d ≥ 5 σ/√SNR (measured on the fit); never taken beyond 3 σ, where any two spots show two
/// maxima.
fn resolution_m(view: &View, snr: f64) -> f64 {
    let camera = &view.camera;
    let sigma = camera.spot_sigma_m;
    let apart = 5.0 * sigma / snr.max(1e-3).sqrt();
    let pitch = camera.x.pitch_m.max(camera.y.pitch_m);
    apart.max(0.5 * pitch).min(3.0 * sigma) * view.ground_scale()
}

/// Probability that detection `i` is spurious: rare on its own, common where one spot may have been split in two. Assumed, not
/// measured; even the largest is no excuse for silence: nine detections in ten frames outweigh it, so that nobody gains
/// more than a second by making the fit doubtful.
fn clutter_probability(detections: &[Detection], i: usize, view: &View) -> f64 {
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
    } else if nearest < OVERLAP * spot_m(view) {
        NEIGHBOURED
    } else {
        ALONE
    }
}

#[cfg(test)]
pub mod fixture {
    use super::*;

    /// A detection at (`x`, `y`), m, errors 0.1 m, of SNR 100 and 2 m of resolution.
    pub fn detection(x: f64, y: f64) -> Detection {
        Detection {
            position: Vector2::new(x, y),
            z_m: 0.0,
            cov: Matrix2::identity() * 0.01,
            by_pose: Matrix2x6::zeros(),
            earlier: Earlier::Nothing,
            energy_j: 1.0,
            flags: Flags::empty(),
            moments: MomentScore::default(),
            snr: 100.0,
            resolution_m: 2.0,
            clutter_probability: 1e-4,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::fixture::detection;
    use super::*;
    use crate::estimate;
    use crate::optics;

    fn view() -> View {
        View::level(&optics::Config::default().camera().unwrap())
    }

    fn emitter(x_m: f64, cov_m2: [[f64; 2]; 2]) -> Emitter {
        Emitter {
            x_m,
            y_m: 0.0,
            cov_m2,
            energy_j: 1e-3,
            energy_std_j: 1e-6,
            sensor_m: [0.0, 0.0],
            velocity: None,
            lasting_cov_m2: None,
            second_moment: estimate::SecondMomentScore::default(),
            flags: Flags::empty(),
        }
    }

    fn of(emitters: Vec<Emitter>, reduced_chi2: f64) -> Vec<Detection> {
        let estimate = Estimate {
            emitters,
            reduced_chi2,
            ..Estimate::default()
        };
        Detection::of(&estimate, 1.0, &view())
    }

    #[test]
    fn a_misfit_inflates_the_covariance() {
        let cov = |chi2: f64| of(vec![emitter(0.0, [[1.0, 0.0], [0.0, 4.0]])], chi2)[0].cov;
        let floor = POSITION_FLOOR_M.powi(2);
        assert_eq!(cov(1.0), Matrix2::new(1.0 + floor, 0.0, 0.0, 4.0 + floor));
        assert_eq!(cov(9.0)[(0, 0)], 9.0 + floor);
        // A χ² below one is luck, and one that is no number is the worst.
        assert_eq!(cov(0.5), cov(1.0));
        assert_eq!(cov(f64::NAN)[(0, 0)], 100.0 + floor);
    }

    #[test]
    fn covariances_that_are_none_are_bounded_or_left_out() {
        let indefinite = of(vec![emitter(0.0, [[1.0, 3.0], [3.0, 1.0]])], 1.0);
        assert!(indefinite[0].cov.determinant() > 0.0);
        assert!(of(vec![emitter(0.0, [[f64::NAN, 0.0], [0.0, 1.0]])], 1.0).is_empty());
        assert!(of(vec![emitter(f64::INFINITY, [[1.0, 0.0], [0.0, 1.0]])], 1.0).is_empty());
    }

    #[test]
    fn clutter_is_rarer_the_better_a_detection_stands_alone() {
        let spot_m = spot_m(&view());
        let beside = |away: f64| {
            let cov = [[1e-4, 0.0], [0.0, 1e-4]];
            of(vec![emitter(0.0, cov), emitter(away, cov)], 1.0)[0].clutter_probability
        };
        assert_eq!(
            [beside(10.0 * spot_m), beside(2.0 * spot_m), beside(0.01)],
            [1e-3, 1e-2, 0.1]
        );
        let mut poor = detection(0.0, 0.0);
        poor.flags = Flags::POOR_FIT;
        assert_eq!(clutter_probability(&[poor], 0, &view()), 0.03);
    }

    #[test]
    fn a_shorter_exposure_has_the_energies_of_the_configured_one_and_its_own_noise() {
        let estimate = Estimate {
            emitters: vec![emitter(0.0, [[0.01, 0.0], [0.0, 0.01]])],
            reduced_chi2: 1.0,
            ..Estimate::default()
        };
        let [usual, short] = [1.0, 16.0].map(|scale| Detection::of(&estimate, scale, &view()).remove(0));
        assert_eq!(short.energy_j, 16.0 * usual.energy_j);
        assert_eq!((short.snr, short.resolution_m), (usual.snr, usual.resolution_m));
    }

    #[test]
    fn two_detections_of_one_spot_are_their_centre_of_light() {
        let view = view();
        let (mut a, b) = (detection(0.0, 0.0), detection(4.0, 0.0));
        a.energy_j = 3.0;
        let both = a.united([&b].into_iter(), &view);
        assert_eq!((both.energy_j, both.snr), (4.0, 200.0));
        assert!((both.position - Vector2::new(1.0, 0.0)).norm() < 1e-12);
        assert_eq!(a.united(std::iter::empty(), &view).position, a.position);
    }
}
