//! How places on the ground lie on the sensor of a platform that moves, and the pose error that all emitters of a frame share.
//!
//! A frame's pose error is found with its energies and projected out as these are: what a frame says of all places together then counts no
//! more than its pose, and what it says of one against another counts in full.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x6, Matrix6, Vector2, Vector6};

use crate::estimate::sequence::local_quadratic::LocalQuadratic;
use crate::geo::Sight;
use crate::optics::Camera;

/// Standard deviations below which a pose is not taken to be known, rad and m: less than a millimetre on the ground.
const LEAST_RAD: f64 = 1e-6;
const LEAST_M: f64 = 1e-4;
/// Steps to a frame's pose error, and the decrease of the deviance below which no more are taken.
const STEPS: usize = 6;
const NEGLIGIBLE_DECREASE: f64 = 1e-3;
/// Longest shift of an emitter in a step, σ: the model is not linear farther out.
const LONGEST_STEP: f64 = 0.5;

/// What a frame of a moving platform sees where. Places are east and north in units of `unit_m`.
pub(crate) struct Outlook {
    sight: Sight,
    camera: Arc<Camera>,
    unit_m: f64,
    /// L of the pose's covariance LLᵀ: pose errors of one standard deviation.
    spread: Matrix6<f64>,
}

/// Where a frame shows some places.
pub(crate) struct Shown {
    /// (x, y) of each on the sensor, σ.
    pub positions: DVector<f64>,
    /// ∂position/∂place of each; zero for one that is out of view.
    by_place: Vec<Matrix2<f64>>,
    /// ∂position/∂pose error, (2n, 6), in standard deviations of the pose.
    by_pose: DMatrix<f64>,
}

impl Outlook {
    pub fn new(sight: &Sight, camera: &Arc<Camera>, unit_m: f64) -> Self {
        let least = [LEAST_RAD, LEAST_RAD, LEAST_RAD, LEAST_M, LEAST_M, LEAST_M].map(|s| s * s);
        let cov = sight.cov() + Matrix6::from_diagonal(&least.into());
        Self {
            sight: sight.clone(),
            camera: camera.clone(),
            unit_m,
            spread: cov.cholesky().map_or_else(Matrix6::zeros, |c| c.l()),
        }
    }

    /// The place that a position on the sensor, σ, shows with a pose error; `None` where its ray meets no ground.
    pub fn place(&self, position: [f64; 2], error: &Vector6<f64>) -> Option<[f64; 2]> {
        let sensor_m = position.map(|u| u * self.camera.spot_sigma_m);
        let point = self.sight.ground(&self.camera, sensor_m)?;
        Some(((point.horizontal_m() + point.by_pose * self.spread * error) / self.unit_m).into())
    }

    /// Where `other` shows what this shows at a position on the sensor, σ; `None` where one of them shows nothing. Pose errors aside.
    pub fn seen_by(&self, other: &Self, position: [f64; 2]) -> Option<[f64; 2]> {
        let [x, y] = self.place(position, &Vector6::zeros())?.map(|p| p * self.unit_m);
        let ground = other.sight.ground_below([x, y])?;
        let sensor_m = other.sight.sensor(&other.camera, [x, y, ground.z_m])?;
        Some(sensor_m.map(|v| v / self.camera.spot_sigma_m))
    }

    /// How a pose error moves places, (2n, 6): all of them together.
    pub fn shared(&self, places: &DVector<f64>) -> DMatrix<f64> {
        let mut shared = DMatrix::zeros(places.len(), 6);
        for e in 0..places.len() / 2 {
            let seen = self
                .sight
                .ground_at([places[2 * e], places[2 * e + 1]].map(|p| p * self.unit_m));
            if let Some(point) = seen {
                let by_pose = point.by_pose * self.spread / self.unit_m;
                shared.fixed_view_mut::<2, 6>(2 * e, 0).copy_from(&by_pose);
            }
        }
        shared
    }

    /// Where the frame shows `places` with a pose error. Whoever is out of `view` is put into its corner.
    pub fn show(&self, places: &DVector<f64>, error: &Vector6<f64>, view: [[f64; 2]; 2]) -> Shown {
        let n = places.len() / 2;
        let mut shown = Shown {
            positions: DVector::from_fn(2 * n, |k, _| view[k % 2][1]),
            by_place: vec![Matrix2::zeros(); n],
            by_pose: DMatrix::zeros(2 * n, 6),
        };
        for e in 0..n {
            let Some((at, by_place, by_pose)) = self.position([places[2 * e], places[2 * e + 1]]) else {
                continue;
            };
            let at = at + by_pose * error;
            if (0..2).all(|k| (view[k][0]..=view[k][1]).contains(&at[k])) {
                shown.positions.fixed_rows_mut::<2>(2 * e).copy_from(&at);
                shown.by_place[e] = by_place;
                shown.by_pose.fixed_view_mut::<2, 6>(2 * e, 0).copy_from(&by_pose);
            }
        }
        shown
    }

    /// Position of a place on the sensor, σ, and its derivatives by the place and by the pose error; `None` where it is not seen.
    fn position(&self, place: [f64; 2]) -> Option<(Vector2<f64>, Matrix2<f64>, Matrix2x6<f64>)> {
        let [x, y] = place.map(|p| p * self.unit_m);
        let ground = self.sight.ground_below([x, y])?;
        let sensor_m = self.sight.sensor(&self.camera, [x, y, ground.z_m])?;
        let point = self.sight.ground(&self.camera, sensor_m)?;
        let sigma = self.camera.spot_sigma_m;
        let by_place = (point.by_sensor * (sigma / self.unit_m)).try_inverse()?;
        let by_pose = -by_place * point.by_pose * self.spread / self.unit_m;
        Some((Vector2::from(sensor_m) / sigma, by_place, by_pose))
    }

    /// The frame about `places`, with its pose error at its best, sought from `error` on. `on_sensor` is the frame about positions on the
    /// sensor, which lie within `view`.
    pub fn fit(
        &self,
        places: &DVector<f64>,
        mut error: Vector6<f64>,
        view: [[f64; 2]; 2],
        mut on_sensor: impl FnMut(DVector<f64>) -> LocalQuadratic,
    ) -> FrameFit {
        let mut at = |error: Vector6<f64>| {
            let shown = self.show(places, &error, view);
            let local = on_sensor(shown.positions.clone());
            FrameFit::new(shown, local, error)
        };
        let mut best = at(error);
        for _ in 0..STEPS {
            if best.decrease < NEGLIGIBLE_DECREASE {
                break;
            }
            let longest = (&best.shown.by_pose * best.step).amax();
            error += best.step * (LONGEST_STEP / longest.max(LONGEST_STEP));
            let next = at(error);
            if !(next.cost() < best.cost()) {
                break;
            }
            best = next;
        }
        best
    }
}

/// A frame about some places and a pose error.
pub(crate) struct FrameFit {
    shown: Shown,
    /// About positions on the sensor.
    pub local: LocalQuadratic,
    error: Vector6<f64>,
    /// The positions' information times `by_pose`, (2n, 6), and the covariance of the pose error where places are known.
    cross: DMatrix<f64>,
    error_cov: Matrix6<f64>,
    /// To the best pose error for these places, and what it takes off the cost.
    step: Vector6<f64>,
    decrease: f64,
}

impl FrameFit {
    fn new(shown: Shown, local: LocalQuadratic, error: Vector6<f64>) -> Self {
        let by_pose = &shown.by_pose;
        let cross = &local.information * by_pose;
        let own = by_pose.tr_mul(&cross).fixed_view::<6, 6>(0, 0) + Matrix6::identity();
        let slope = by_pose.tr_mul(&local.gradient).fixed_rows::<6>(0) - error;
        let error_cov = own.cholesky().map_or_else(Matrix6::zeros, |c| c.inverse());
        let step = error_cov * slope;
        Self {
            decrease: slope.dot(&step),
            shown,
            local,
            error,
            cross,
            error_cov,
            step,
        }
    }

    fn cost(&self) -> f64 {
        self.local.deviance + self.error.norm_squared()
    }

    /// The same about `places`, the pose error projected out.
    pub fn about(self, places: DVector<f64>) -> LocalQuadratic {
        let by_place = self.by_place();
        let information = &self.local.information - &self.cross * self.error_cov * self.cross.transpose();
        let gradient = &self.local.gradient - &self.cross * self.step;
        LocalQuadratic {
            deviance: self.cost() - self.decrease,
            positions: places,
            gradient: by_place.tr_mul(&gradient),
            information: by_place.tr_mul(&information) * by_place,
            pose_error: self.error + self.step,
            ..self.local
        }
    }

    /// Covariance of the positions on the sensor where that of the places is `cov`, which holds what this frame says.
    pub fn cov_on_sensor(&self, cov: &DMatrix<f64>) -> DMatrix<f64> {
        let Shown { by_pose, .. } = &self.shown;
        let by_place = self.by_place();
        let of_places = &by_place - by_pose * self.error_cov * self.cross.transpose() * &by_place;
        &of_places * cov * of_places.transpose() + by_pose * self.error_cov * by_pose.transpose()
    }

    /// ∂position/∂place, (2n, 2n).
    fn by_place(&self) -> DMatrix<f64> {
        let blocks = &self.shown.by_place;
        let mut by_place = DMatrix::zeros(2 * blocks.len(), 2 * blocks.len());
        for (e, block) in blocks.iter().enumerate() {
            by_place.fixed_view_mut::<2, 2>(2 * e, 2 * e).copy_from(block);
        }
        by_place
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::estimate::fit::work_budget::WorkBudget;
    use crate::estimate::model::hypothesis::Nuisances;
    use crate::estimate::sequence::local_quadratic::{Energies, Engine};
    use crate::estimate::sequence::snapshot::view;
    use crate::estimate::test_frame::{Shown as Showing, TestFrame};
    use crate::pose::{Mount, Pose, PoseSigmas};

    const SOURCES: [([f64; 2], f64); 3] = [([0.3, -0.4], 200.0), ([1.9, 1.2], 150.0), ([-2.0, 1.5], 180.0)];

    fn showing() -> TestFrame {
        Showing {
            pixels_per_sigma: 2.0,
            sources: &SOURCES,
            noise: Some(5),
            ..Showing::default()
        }
        .frame()
    }

    /// A tilted camera that is known to `share` of 3 mrad and half a metre.
    fn outlook(test: &TestFrame, share: f64) -> Outlook {
        let sigmas = PoseSigmas {
            attitude_rad: share * 3e-3,
            position_m: share * 0.5,
        };
        let pose = Pose {
            attitude: UnitQuaternion::from_euler_angles(0.05, -0.08, 0.7),
            cov: sigmas.cov(),
            ..Pose::level(Timestamp::UNIX_EPOCH, [12.0, -7.0, 290.0])
        };
        Outlook::new(
            &Sight::new(&pose, &Mount::default()),
            &Arc::new(test.camera.clone()),
            unit_m(test),
        )
    }

    fn unit_m(test: &TestFrame) -> f64 {
        test.camera.ground_scale() * test.camera.spot_sigma_m
    }

    fn places(outlook: &Outlook) -> DVector<f64> {
        let places = SOURCES.map(|(u, _)| outlook.place(u, &Vector6::zeros()).expect("looks down"));
        DVector::from_column_slice(places.as_flattened())
    }

    fn fit(test: &mut TestFrame, outlook: &Outlook, places: &DVector<f64>) -> FrameFit {
        let mut engine = Engine {
            bases: &test.space.bases,
            rules: Default::default(),
            budget: &mut WorkBudget::new(&|| false),
            workspace: &mut test.space.workspace,
        };
        let view = view(engine.bases);
        outlook.fit(places, Vector6::zeros(), view, |positions| {
            LocalQuadratic::new(
                &mut engine,
                &test.compressed,
                Energies::NonNegative,
                Nuisances::default(),
                positions,
            )
        })
    }

    #[test]
    fn a_place_is_shown_where_it_was_seen_whatever_the_pose_error() {
        let test = showing();
        let outlook = outlook(&test, 1.0);
        let view = view(&test.space.bases);
        for error in [Vector6::zeros(), Vector6::new(0.5, -1.0, 2.0, 0.3, -0.7, 1.0)] {
            let places = SOURCES.map(|(u, _)| outlook.place(u, &error).expect("looks down"));
            let shown = outlook.show(&DVector::from_column_slice(places.as_flattened()), &error, view);
            for (k, (u, _)) in SOURCES.iter().enumerate() {
                let off = (shown.positions[2 * k] - u[0]).hypot(shown.positions[2 * k + 1] - u[1]);
                // The pose error counts to first order.
                assert!(off < 1e-9 + 0.01 * error.norm(), "{off}");
            }
        }
    }

    #[test]
    fn the_gradient_is_that_of_the_cost_with_the_pose_error_at_its_best() {
        let mut test = showing();
        let outlook = outlook(&test, 1.0);
        let at = places(&outlook) + DVector::from_column_slice(&[0.02, -0.01, 0.03, 0.01, -0.02, 0.02]);
        let quadratic = fit(&mut test, &outlook, &at).about(at.clone());
        for k in 0..6 {
            let h = 1e-4;
            let mut cost = |sign: f64| {
                let mut moved = at.clone();
                moved[k] += sign * h;
                fit(&mut test, &outlook, &moved).about(moved).deviance
            };
            let slope = (cost(1.0) - cost(-1.0)) / (2.0 * h);
            let expected = -2.0 * quadratic.gradient[k];
            assert!(
                (slope - expected).abs() < 0.02 * (1.0 + expected.abs()),
                "{k}: {slope} against {expected}"
            );
        }
    }

    #[test]
    fn what_is_common_to_all_is_known_as_well_as_the_pose_and_the_rest_as_from_the_frame() {
        let mut test = showing();
        let unit = unit_m(&test);
        let (loose, exact) = (outlook(&test, 1.0), outlook(&test, 0.01));
        let at = places(&loose);
        let variance = |outlook: &Outlook, test: &mut TestFrame, along: &[f64]| {
            let information = fit(test, outlook, &at).about(at.clone()).information;
            let cov = information.cholesky().expect("regular").inverse();
            let along = DVector::from_column_slice(along);
            (cov * &along).dot(&along)
        };
        let third = 1.0 / 3.0;
        let together = [third, 0.0, third, 0.0, third, 0.0];
        let apart = [1.0, 0.0, -1.0, 0.0, 0.0, 0.0];
        let (common, own) = (
            variance(&loose, &mut test, &together),
            variance(&exact, &mut test, &together),
        );
        // 3 mrad over 290 m and half a metre.
        let pose = (0.87f64.powi(2) + 0.25) / unit.powi(2);
        assert!((0.8..1.3).contains(&((common - own) / pose)), "{common} {own} {pose}");
        let (common, own) = (variance(&loose, &mut test, &apart), variance(&exact, &mut test, &apart));
        assert!((0.0..0.1).contains(&((common - own) / pose)), "{common} {own} {pose}");
    }

    #[test]
    fn positions_on_the_sensor_are_known_as_well_as_from_the_frame_alone() {
        let mut test = showing();
        let outlook = outlook(&test, 1.0);
        let at = places(&outlook);
        let found = fit(&mut test, &outlook, &at);
        let own = found.local.information.clone().cholesky().expect("regular").inverse();
        // Nothing is known of the places but by this frame.
        let of_places = fit(&mut test, &outlook, &at).about(at.clone()).information;
        let cov = found.cov_on_sensor(&of_places.cholesky().expect("regular").inverse());
        assert!((&cov - &own).norm() < 1e-3 * own.norm(), "{cov} {own}");
    }
}
