//! What the poses' source and the users' claims together say of the pose error that lasts: the source's own covariance is the
//! prior, each claim that a beam answers is a measurement.

use nalgebra::{Matrix2, Matrix2x6, Matrix3, Matrix6, SMatrix, SVector, Vector2};

use crate::geo::PoseError;
use crate::monitor::stats::gaussian::mahalanobis2;
use crate::monitor::stats::robust::{median_vector, variance_of_median};

/// Time over which claims are averaged, s. Longer is more exact, shorter follows a heading or a place that wanders. Not measured.
const SMOOTHING_S: f64 = 10.0;
/// Distance, in standard deviations, at which a user's weight is a half (Cauchy): liars move nothing by much.
const HALF_WEIGHT: f64 = 2.0;
/// Distance beyond which a user does not count, standard deviations.
const OUTSIDE: f64 = 5.0;
/// Users that say together how the pose is off, at least: with fewer one of them would.
const MIN_SHARING: usize = 3;
/// Turn in the world, shift in the world, turn with the camera.
pub const STATE: usize = 9;
/// Share of the stated attitude error's variance that is fixed in the world, as a heading's by the earth's field; the rest is fixed in the
/// platform, as a mount's or a tilt's by an accelerometer's. While the platform does not turn the two are the same. Not measured.
const IN_THE_WORLD: f64 = 0.5;
/// Variances below which no pose is taken to be known, rad² and m²: keeps the prior regular.
const LEAST: [f64; 2] = [1e-12, 1e-8];

pub type State = SVector<f64, STATE>;
type ToPose = SMatrix<f64, 6, STATE>;
type StateMatrix = SMatrix<f64, STATE, STATE>;

/// The lasting error of the pose, about north, east, down (rad), then east, north, up (m): a part of the turn stays in the world, a part
/// turns with the camera.
#[derive(Clone, Debug, Default)]
pub struct PoseBias {
    /// Covariance that the newest fresh pose stated; the first one where none was fresh yet.
    prior: Option<Matrix6<f64>>,
    information: StateMatrix,
    /// The same with the squares of the weights: how much the weighted sums scatter.
    scatter: StateMatrix,
    vector: State,
    state: State,
    /// From the state to the newest pose's error.
    to_pose: ToPose,
    error: PoseError,
    cov: Matrix6<f64>,
}

/// A claim that a beam answers: how far apart the two are, m, the claim's variance per axis, m², and how the pose moves the beam.
pub struct Residual {
    pub offset: Vector2<f64>,
    pub variance: f64,
    pub by_pose: Matrix2x6<f64>,
}

/// How far beams are from their claims together.
#[derive(Clone, Copy, Debug, Default)]
pub struct SharedOffset {
    /// What the lasting error leaves, m.
    pub left: Vector2<f64>,
    /// The lasting error, and how it displaces users in the mean.
    pub state: State,
    pub by_state: SMatrix<f64, 2, STATE>,
    /// Of what is left, per axis, m².
    pub variance: f64,
}

impl PoseBias {
    pub fn error(&self) -> &PoseError {
        &self.error
    }

    pub fn cov(&self) -> &Matrix6<f64> {
        &self.cov
    }

    pub fn has_prior(&self) -> bool {
        self.prior.is_some()
    }

    /// Takes one frame's residuals, `dt` seconds after the last one's; each user claims every `period_s`. `axes` turns the camera's axes to
    /// north, east, down. `prior` is the covariance of the pose where that is fresh: what lasts does not grow with a pose's age.
    pub fn update(
        &mut self,
        residuals: &[Residual],
        axes: &Matrix3<f64>,
        prior: Option<&Matrix6<f64>>,
        dt: f64,
        period_s: f64,
    ) {
        self.prior = prior.copied().or(self.prior);
        let Some(prior) = self.prior else {
            return;
        };
        let [turn, shift] = LEAST;
        let prior = prior + Matrix6::from_diagonal(&[turn, turn, turn, shift, shift, shift].into());
        let Some(prior) = Prior::new(&prior, axes) else {
            return;
        };
        let keep = (-dt / SMOOTHING_S).exp();
        self.information *= keep;
        self.scatter *= keep * keep;
        self.vector *= keep;
        let share = (dt / period_s.max(0.01)).min(1.0);
        let is_outside = |r: &&Residual| !(self.distance2(r) < OUTSIDE * OUTSIDE);
        if 2 * residuals.iter().filter(is_outside).count() > residuals.len() {
            // Most users are elsewhere: what was learned is of another pose.
            *self = Self {
                prior: self.prior,
                ..Self::default()
            };
            self.solve(&prior);
        }
        for r in residuals {
            let d2 = self.distance2(r);
            if !(d2 < OUTSIDE * OUTSIDE) {
                continue;
            }
            let weight = 1.0 / (1.0 + d2 / (HALF_WEIGHT * HALF_WEIGHT));
            let by_state = r.by_pose * prior.to_pose;
            let information = by_state.transpose() * by_state * (share / r.variance);
            self.information += information * weight;
            self.scatter += information * weight * weight;
            self.vector += by_state.transpose() * r.offset * (share / r.variance * weight);
        }
        self.solve(&prior);
    }

    /// What residuals share: of what the lasting error leaves of each the median, which liars fewer than a half do not choose. None with
    /// fewer than three.
    pub fn shared_offset(&self, residuals: &[Residual]) -> Option<SharedOffset> {
        let n = residuals.len();
        (n >= MIN_SHARING).then(|| SharedOffset {
            left: median_vector(residuals.iter().map(|r| r.offset - r.by_pose * self.error.vector())),
            state: self.state,
            by_state: residuals.iter().map(|r| r.by_pose).sum::<Matrix2x6<f64>>() * self.to_pose / n as f64,
            variance: variance_of_median(residuals.iter().map(|r| r.variance).sum::<f64>() / n as f64, n),
        })
    }

    /// Squared distance of a claim from its beam, standard deviations.
    fn distance2(&self, r: &Residual) -> f64 {
        let spread = r.by_pose * self.cov * r.by_pose.transpose() + Matrix2::identity() * r.variance;
        mahalanobis2(r.offset - r.by_pose * self.error.vector(), spread)
    }

    fn solve(&mut self, prior: &Prior) {
        // The variance of a weighted mean (Huber, 1967): newer claims and nearer ones weigh more than others.
        let weighted = (prior.information + self.information).cholesky().map(|c| c.inverse());
        let inverse = weighted.unwrap_or(prior.cov);
        let cov = inverse * (prior.information + self.scatter) * inverse;
        self.state = inverse * self.vector;
        self.to_pose = prior.to_pose;
        self.cov = self.to_pose * cov * self.to_pose.transpose();
        self.error = PoseError::of(self.to_pose * self.state);
    }
}

/// What the poses' source says of the state.
struct Prior {
    /// From the state to the pose's error.
    to_pose: ToPose,
    cov: StateMatrix,
    information: StateMatrix,
}

impl Prior {
    /// `None` where `pose` is no covariance.
    fn new(pose: &Matrix6<f64>, axes: &Matrix3<f64>) -> Option<Self> {
        let mut to_pose = ToPose::identity();
        to_pose.fixed_view_mut::<3, 3>(0, 6).copy_from(axes);
        // Of two independent errors, one fixed in the world and one in the camera, whose sum is the pose's.
        let in_world = SMatrix::<f64, STATE, 6>::identity();
        let mut in_camera = SMatrix::<f64, STATE, 6>::zeros();
        in_camera.fixed_view_mut::<3, 3>(3, 3).copy_from(&Matrix3::identity());
        in_camera.fixed_view_mut::<3, 3>(6, 0).copy_from(&axes.transpose());
        let part = |to_state: &SMatrix<f64, STATE, 6>, share: f64| to_state * pose * to_state.transpose() * share;
        let cov = part(&in_world, IN_THE_WORLD) + part(&in_camera, 1.0 - IN_THE_WORLD);
        let information = cov.cholesky()?.inverse();
        Some(Self {
            to_pose,
            cov,
            information,
        })
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use nalgebra::Vector6;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::geo::Sight;
    use crate::pose::{Mount, Pose, PoseSigmas};

    const USERS: [[f64; 2]; 6] = [
        [60.0, 10.0],
        [-50.0, 40.0],
        [0.0, -70.0],
        [80.0, -60.0],
        [-70.0, -50.0],
        [20.0, 60.0],
    ];

    /// The bias after a minute in which the beams of `users` are displaced by a pose error, and those of the first `liars` by 8 m
    /// more.
    fn found(users: usize, liars: usize, error: &Vector6<f64>) -> PoseBias {
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [5.0, -8.0, 300.0]);
        let sight = Sight::new(&pose, &Mount::default());
        let prior = PoseSigmas {
            attitude_rad: 0.02,
            position_m: 1.0,
        };
        let residual = |(k, [x, y]): (usize, &[f64; 2])| {
            let by_pose = sight.apparent([*x, *y, 0.0]).expect("below").by_pose;
            let lie = Vector2::new(if k < liars { 8.0 } else { 0.0 }, 0.0);
            Residual {
                offset: by_pose * error + lie,
                variance: 0.09,
                by_pose,
            }
        };
        let residuals: Vec<_> = USERS[..users].iter().enumerate().map(residual).collect();
        let mut bias = PoseBias::default();
        (0..600).for_each(|_| bias.update(&residuals, &Matrix3::identity(), Some(&prior.cov()), 0.1, 1.0));
        bias
    }

    /// Largest displacement that is left at the users' places, m.
    fn left(bias: &PoseBias, error: &Vector6<f64>) -> f64 {
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [5.0, -8.0, 300.0]);
        let sight = Sight::new(&pose, &Mount::default());
        let at =
            |[x, y]: [f64; 2]| sight.apparent([x, y, 0.0]).expect("below").by_pose * (error - bias.error().vector());
        USERS.into_iter().map(|p| at(p).norm()).fold(0.0, f64::max)
    }

    #[test]
    fn what_lasts_keeps_the_covariance_of_the_last_fresh_pose() {
        let error = Vector6::new(0.003, -0.002, 0.02, 0.5, -0.4, 0.3);
        let mut old = found(6, 0, &error);
        let before = *old.cov();
        // Without claims only the prior is left.
        (0..3000).for_each(|_| old.update(&[], &Matrix3::identity(), None, 0.1, 1.0));
        let stated = PoseSigmas {
            attitude_rad: 0.02,
            position_m: 1.0,
        };
        for k in 0..6 {
            let ratio = old.cov()[(k, k)] / stated.cov()[(k, k)];
            assert!(
                (0.99..1.01).contains(&ratio) && before[(k, k)] < old.cov()[(k, k)],
                "{k}: {ratio}"
            );
        }
    }

    #[test]
    fn the_covariance_is_what_claims_scatter_by() {
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [5.0, -8.0, 300.0]);
        let sight = Sight::new(&pose, &Mount::default());
        let by_pose = USERS.map(|[x, y]| sight.apparent([x, y, 0.0]).expect("below").by_pose);
        let prior = PoseSigmas {
            attitude_rad: 0.02,
            position_m: 1.0,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut normal = |std: f64| {
            let z: f64 = StandardNormal.sample(&mut rng);
            std * z
        };
        let mut mean = 0.0;
        const RUNS: usize = 200;
        for _ in 0..RUNS {
            let [turn, shift] = [0.02, 1.0].map(|std| [0; 3].map(|_| normal(std)));
            let error = Vector6::from_iterator(turn.into_iter().chain(shift));
            let mut bias = PoseBias::default();
            for _ in 0..60 {
                let residuals = by_pose.map(|by_pose| Residual {
                    offset: by_pose * error + Vector2::new(normal(0.3), normal(0.3)),
                    variance: 0.09,
                    by_pose,
                });
                (0..10).for_each(|_| bias.update(&residuals, &Matrix3::identity(), Some(&prior.cov()), 0.1, 1.0));
            }
            for h in by_pose {
                let off = h * (error - bias.error().vector());
                mean += mahalanobis2(off, h * bias.cov() * h.transpose()) / (2 * by_pose.len() * RUNS) as f64;
            }
        }
        assert!((0.85..1.25).contains(&mean), "{mean}");
    }

    #[test]
    fn a_tilt_a_heading_and_a_shift_are_found_from_six_users() {
        let error = Vector6::new(0.003, -0.004, 0.026, 1.2, -0.7, 1.0);
        let bias = found(6, 0, &error);
        assert!(left(&bias, &error) < 0.1, "{}", left(&bias, &error));
        // The prior alone leaves what the error makes.
        assert!(left(&found(0, 0, &error), &error) > 2.0);
    }

    #[test]
    fn a_mount_s_error_is_found_on_a_platform_that_turns() {
        let pose = |t: f64| Pose {
            attitude: nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, 0.1 * t),
            ..Pose::level(Timestamp::UNIX_EPOCH, [5.0, -8.0, 300.0])
        };
        let prior = PoseSigmas {
            attitude_rad: 0.02,
            position_m: 1.0,
        };
        let mount = nalgebra::Vector3::new(0.02, -0.015, 0.01);
        let mut bias = PoseBias::default();
        let mut largest: f64 = 0.0;
        for k in 0..900 {
            let sight = Sight::new(&pose(0.1 * f64::from(k)), &Mount::default());
            let axes = sight.axes();
            let turn = axes * mount;
            let error = Vector6::new(turn.x, turn.y, turn.z, 0.4, -0.3, 0.2);
            let residuals = USERS.map(|[x, y]| {
                let by_pose = sight.apparent([x, y, 0.0]).expect("below").by_pose;
                Residual {
                    offset: by_pose * error,
                    variance: 0.09,
                    by_pose,
                }
            });
            bias.update(&residuals, &axes, Some(&prior.cov()), 0.1, 1.0);
            let left = |r: &Residual| (r.by_pose * (error - bias.error().vector())).norm();
            if k > 300 {
                largest = residuals.iter().map(left).fold(largest, f64::max);
            }
        }
        assert!(largest < 0.2, "{largest}");
    }

    #[test]
    fn a_liar_hardly_moves_what_users_share_and_two_users_share_nothing() {
        let residual = |k: usize| Residual {
            offset: Vector2::new(if k == 0 { 50.0 } else { 1.0 + 0.1 * k as f64 }, 0.0),
            variance: 0.09,
            by_pose: Matrix2x6::zeros(),
        };
        let of = |users: usize| PoseBias::default().shared_offset(&(0..users).map(residual).collect::<Vec<_>>());
        assert!(of(2).is_none());
        // The median of 1.1 to 1.5 and of 50.
        assert!((of(6).expect("enough").left.x - 1.35).abs() < 1e-12);
    }

    #[test]
    fn one_user_corrects_their_own_place_and_liars_few() {
        let error = Vector6::new(0.003, -0.004, 0.0, 1.2, -0.7, 0.0);
        assert!(left(&found(1, 0, &error), &error) < 1.0);
        let honest = Vector6::zeros();
        assert!(
            left(&found(6, 1, &honest), &honest) < 0.6,
            "{}",
            left(&found(6, 1, &honest), &honest)
        );
    }
}
