//! The camera's rays in the world, from its pose: sensor to ground and back, with Jacobians.

use std::sync::Arc;

use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Matrix3, Matrix6, Vector2, Vector3, Vector6};

use super::pose_error::PoseError;
use super::terrain::{Ground, Terrain};
use crate::optics::{Axis, Camera};
use crate::pose::{Mount, Pose, swap_ned_enu};

/// Least angle to the ground, as the sine, of a ray that meets it: on a plane, flatter ones end more than fifty heights away.
const MIN_DESCENT: f64 = 0.02;

/// Where the camera is and looks in one frame.
#[derive(Clone, Debug)]
pub struct Sight {
    /// East, north, up, m.
    lens_m: Vector3<f64>,
    /// Camera (sensor +y, sensor +x, optical axis) to east, north, up.
    to_world: Matrix3<f64>,
    /// Covariance of the pose, as [`Pose::cov`] has it.
    cov: Matrix6<f64>,
    /// The ground; without it the plane z = 0.
    terrain: Option<Arc<Terrain>>,
}

/// Where a ray meets the ground.
#[derive(Clone, Copy, Debug)]
pub struct GroundPoint {
    /// East, north, up, m.
    pub position_m: Vector3<f64>,
    /// ∂(east, north)/∂(sensor x, y).
    pub by_sensor: Matrix2<f64>,
    /// ∂(east, north)/∂(rotation vector about north, east, down, rad; lens east, north, up, m).
    pub by_pose: Matrix2x6<f64>,
    /// Upwards across the ground, with an upward part of 1.
    normal: Vector3<f64>,
}

impl Sight {
    pub fn new(pose: &Pose, mount: &Mount) -> Self {
        let camera_to_ned = (pose.attitude * mount.rotation()).to_rotation_matrix();
        let columns = [0, 1, 2].map(|k| swap_ned_enu(camera_to_ned.matrix().column(k).into()));
        Self {
            lens_m: pose.position_m.into(),
            to_world: Matrix3::from_columns(&columns),
            cov: pose.cov,
            terrain: None,
        }
    }

    /// The same over terrain, where there is one.
    pub fn over(self, terrain: Option<Arc<Terrain>>) -> Self {
        Self { terrain, ..self }
    }

    pub fn lens_m(&self) -> Vector3<f64> {
        self.lens_m
    }

    /// The lens above the ground below it, m; above z = 0 where the ground's height is not known.
    pub fn height_m(&self) -> f64 {
        match &self.terrain {
            None => self.lens_m.z,
            Some(terrain) => self.lens_m.z - terrain.at(self.lens_m.xy().into()).map_or(0.0, |ground| ground.z_m),
        }
    }

    /// Ground metres per sensor metre straight below.
    pub fn ground_scale(&self, camera: &Camera) -> f64 {
        self.height_m() / (camera.plane_distance_m * camera.distortion.focal_scale)
    }

    pub fn has_terrain(&self) -> bool {
        self.terrain.is_some()
    }

    pub fn cov(&self) -> &Matrix6<f64> {
        &self.cov
    }

    /// From the camera's axes to north, east, down.
    pub fn axes(&self) -> Matrix3<f64> {
        let columns = [0, 1, 2].map(|k| swap_ned_enu(self.to_world.column(k).into()));
        Matrix3::from_columns(&columns)
    }

    /// The same with the pose corrected by a rotation vector (north, east, down) and a shift (east, north, up), which are then
    /// known to `cov`.
    pub fn corrected(&self, by: &Vector6<f64>, cov: Matrix6<f64>) -> Self {
        let by = PoseError::of(*by);
        Self {
            lens_m: self.lens_m + by.shift_m(),
            to_world: by.turn * self.to_world,
            cov,
            terrain: self.terrain.clone(),
        }
    }

    /// The ground at a sensor position, m; `None` where the ray meets no ground that is known.
    pub fn ground(&self, camera: &Camera, sensor: [f64; 2]) -> Option<GroundPoint> {
        let z = camera.plane_distance_m;
        let [tx, ty] = camera.distortion.unproject(z, sensor);
        let [[a, b], [c, d]] = camera.distortion.project_jacobian(z, [tx, ty]);
        let det = a * d - b * c;
        let ray = self.to_world * Vector3::new(ty, tx, 1.0);
        let mut point = self.meet(ray)?;
        let reach = (point.position_m - self.lens_m).norm() / ray.norm();
        // Along the ground, of the ray's components: tangents follow the sensor by the inverse of the projection's Jacobian.
        let along = horizontal(&onto_ground(&ray, &point.normal)) * self.to_world * reach;
        let by_tangents = Matrix2::from_columns(&[along.column(1).into_owned(), along.column(0).into_owned()]);
        point.by_sensor = by_tangents * Matrix2::new(d, -b, -c, a) / det;
        Some(point)
    }

    /// Whether the middle of the sensor or one of its corners shows ground.
    pub fn sees_ground(&self, camera: &Camera) -> bool {
        let [x, y] = [&camera.x, &camera.y].map(Axis::half_width);
        let places = [[0.0, 0.0], [x, y], [x, -y], [-x, y], [-x, -y]];
        places.into_iter().any(|sensor| self.ground(camera, sensor).is_some())
    }

    /// Where the ray from the lens through a place meets the ground: where a beam from there appears to come from.
    pub fn apparent(&self, place_m: [f64; 3]) -> Option<GroundPoint> {
        self.meet(Vector3::from(place_m) - self.lens_m)
    }

    /// The ground that a beam from the ground at a place, east and north, m, appears to come from, where the pose is off by `error`, as
    /// [`Sight::corrected`] has it.
    pub fn seen_with_error(&self, place_m: [f64; 2], error: &PoseError) -> Option<GroundPoint> {
        let [x, y] = place_m;
        let z_m = self.ground_below(place_m)?.z_m;
        self.meet(error.turn * (Vector3::new(x, y, z_m) - self.lens_m + error.shift_m()))
    }

    /// The ground that a beam comes from which appears to come from there, where the pose is off by `error`.
    pub fn seen_without_error(&self, seen_m: [f64; 2], error: &PoseError) -> Option<GroundPoint> {
        let [x, y] = seen_m;
        let z_m = self.ground_below(seen_m)?.z_m;
        let ray = error.turn.inverse() * (Vector3::new(x, y, z_m) - self.lens_m);
        self.meet_from(self.lens_m - error.shift_m(), ray)
    }

    /// The sensor position, m, of a place in the world; `None` behind the camera.
    pub fn sensor(&self, camera: &Camera, place_m: [f64; 3]) -> Option<[f64; 2]> {
        let seen = self.to_world.transpose() * (Vector3::from(place_m) - self.lens_m);
        if !(seen.z > 1e-6 * seen.norm()) {
            return None;
        }
        let tangents = [seen.y / seen.z, seen.x / seen.z];
        Some(camera.distortion.project(camera.plane_distance_m, tangents))
    }

    /// How far in front of the lens a place in the world is, along the optical axis, and its distance, m.
    pub fn depth_and_distance_m(&self, place_m: [f64; 3]) -> (f64, f64) {
        let way = Vector3::from(place_m) - self.lens_m;
        (self.to_world.column(2).dot(&way), way.norm())
    }

    /// The ground below or above a place, east and north; `None` where it is not known.
    pub fn ground_below(&self, place_m: [f64; 2]) -> Option<Ground> {
        match &self.terrain {
            Some(terrain) => terrain.at(place_m),
            None => Some(Ground {
                z_m: 0.0,
                slope: [0.0; 2],
            }),
        }
    }

    /// The ground at a place, m, as high as that below the lens where the map has a void; `None` off the map.
    pub fn ground_about(&self, place_m: [f64; 2]) -> Option<Ground> {
        self.ground_below(place_m).or_else(|| {
            let half_m = self.terrain.as_ref()?.half_m();
            let is_on_map = place_m.iter().all(|v| v.abs() <= half_m);
            is_on_map.then(|| self.ground_below(self.lens_m.xy().into()))?
        })
    }

    /// The ground at a place, east and north, as a ray to there would meet it. Where it cannot be seen, behind a hill, it is taken
    /// to be level.
    pub fn ground_at(&self, place_m: [f64; 2]) -> Option<GroundPoint> {
        let [x, y] = place_m;
        if self.terrain.is_none() {
            return self.apparent([x, y, 0.0]);
        }
        let ground = self.ground_below(place_m)?;
        let ray = Vector3::new(x, y, ground.z_m) - self.lens_m;
        let is_met = |normal: &Vector3<f64>| is_steep(&ray, normal);
        let normal = Some(normal(&ground))
            .filter(is_met)
            .or(Some(Vector3::z()).filter(is_met))?;
        Some(GroundPoint::at(self.lens_m, &ray, 1.0, normal))
    }

    fn meet(&self, ray: Vector3<f64>) -> Option<GroundPoint> {
        self.meet_from(self.lens_m, ray)
    }

    fn meet_from(&self, lens_m: Vector3<f64>, ray: Vector3<f64>) -> Option<GroundPoint> {
        if let Some(terrain) = &self.terrain {
            let crossing = terrain.cross(&lens_m, &ray)?;
            let normal = normal(&crossing.ground);
            return is_steep(&ray, &normal).then(|| GroundPoint::at(lens_m, &ray, crossing.reach, normal));
        }
        if !(-ray.z > MIN_DESCENT * ray.norm()) || !(lens_m.z > 0.0) {
            return None;
        }
        let mut point = GroundPoint::at(lens_m, &ray, -lens_m.z / ray.z, Vector3::z());
        point.position_m.z = 0.0;
        Some(point)
    }
}

fn normal(ground: &Ground) -> Vector3<f64> {
    let [by_x, by_y] = ground.slope;
    Vector3::new(-by_x, -by_y, 1.0)
}

/// Whether a ray comes down onto the ground steeply enough to say where.
fn is_steep(ray: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
    -ray.dot(normal) > MIN_DESCENT * ray.norm() * normal.norm()
}

/// Slides a displacement of a ray's end along the ray onto the ground: 1 − ray·nᵀ/(n·ray).
fn onto_ground(ray: &Vector3<f64>, normal: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::identity() - ray * normal.transpose() / ray.dot(normal)
}

fn horizontal(m: &Matrix3<f64>) -> Matrix2x3<f64> {
    m.fixed_view::<2, 3>(0, 0).into_owned()
}

impl GroundPoint {
    /// Where a ray from the lens ends on ground with a normal.
    fn at(lens_m: Vector3<f64>, ray: &Vector3<f64>, reach: f64, normal: Vector3<f64>) -> Self {
        let way = ray * reach;
        let onto = onto_ground(ray, &normal);
        let by_shift = [0, 1].map(|k| onto.row(k).transpose());
        // A turn δ (north, east, down) moves the ray by (Sδ) × ray, S being the change of axes, and a place by h·((Sδ) × ray) = (ray × h)·Sδ.
        let by_turn = by_shift.map(|h| swap_ned_enu(way.cross(&h)));
        Self {
            position_m: lens_m + way,
            by_sensor: Matrix2::zeros(),
            by_pose: Matrix2x6::from_fn(|r, c| if c < 3 { by_turn[r][c] } else { by_shift[r][c - 3] }),
            normal,
        }
    }

    pub fn horizontal_m(&self) -> Vector2<f64> {
        self.position_m.xy()
    }

    /// Covariance that the pose's makes here, m².
    pub fn pose_cov(&self, cov: &Matrix6<f64>) -> Matrix2<f64> {
        self.by_pose * cov * self.by_pose.transpose()
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use nalgebra::UnitQuaternion;

    use super::*;

    fn camera() -> Camera {
        let mut camera = crate::optics::Config::default().camera().unwrap();
        camera.distortion.radial = [0.12, -0.03, 0.0];
        camera.distortion.principal_point_m = [1e-4, 2e-4];
        camera
    }

    fn tilted() -> Pose {
        Pose {
            attitude: UnitQuaternion::from_euler_angles(0.12, -0.2, 2.1),
            ..Pose::level(Timestamp::UNIX_EPOCH, [40.0, -25.0, 280.0])
        }
    }

    #[test]
    fn level_and_heading_north_is_the_geometry_of_the_fixed_platform() {
        let camera = camera();
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, camera.altitude_m]);
        let sight = Sight::new(&pose, &Mount::default());
        for sensor in [[0.0, 0.0], [0.012, -0.004], [-0.015, 0.015]] {
            let point = sight.ground(&camera, sensor).expect("looks down");
            let [x, y] = camera.to_ground(sensor);
            assert!((point.horizontal_m() - Vector2::new(x, y)).norm() < 1e-10);
            let cov = camera.cov_to_ground(sensor, [[2e-9, 5e-10], [5e-10, 1e-9]]);
            let own = point.by_sensor * Matrix2::new(2e-9, 5e-10, 5e-10, 1e-9) * point.by_sensor.transpose();
            assert!((own - Matrix2::new(cov[0][0], cov[0][1], cov[1][0], cov[1][1])).norm() < 1e-9 * own.norm());
            let back = sight.sensor(&camera, point.position_m.into()).expect("in front");
            assert!((back[0] - sensor[0]).hypot(back[1] - sensor[1]) < 1e-14);
        }
    }

    #[test]
    fn heading_east_the_sensor_s_y_is_east_and_its_x_south() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let pose = Pose {
            attitude: UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2),
            ..Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0])
        };
        let sight = Sight::new(&pose, &Mount::default());
        let at = |sensor| sight.ground(&camera, sensor).expect("looks down").horizontal_m();
        let scale = 300.0 / camera.plane_distance_m;
        assert!((at([0.0, 0.01]) - Vector2::new(0.01 * scale, 0.0)).norm() < 1e-9);
        assert!((at([0.01, 0.0]) - Vector2::new(0.0, -0.01 * scale)).norm() < 1e-9);
        // A mount turned by yaw 90° on a platform that heads north is the same.
        let north = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0]);
        let mount = Mount {
            yaw_deg: 90.0,
            ..Mount::default()
        };
        assert!((Sight::new(&north, &mount).to_world - sight.to_world).norm() < 1e-12);
    }

    #[test]
    fn jacobians_are_those_of_finite_differences() {
        let (camera, pose) = (camera(), tilted());
        let mount = Mount {
            roll_deg: 3.0,
            pitch_deg: -5.0,
            yaw_deg: 80.0,
        };
        let sight = Sight::new(&pose, &mount);
        for sensor in [[0.0, 0.0], [0.011, -0.007], [-0.014, 0.013]] {
            let point = sight.ground(&camera, sensor).expect("looks down");
            let difference = |up: Vector2<f64>, down: Vector2<f64>, h: f64| (up - down) / (2.0 * h);
            for k in 0..2 {
                // The step balances rounding (1e-13 of 300 m over h) and the third derivative.
                let h = 1e-7;
                let at = |s: f64| {
                    let moved = std::array::from_fn(|i| sensor[i] + if i == k { s } else { 0.0 });
                    sight.ground(&camera, moved).expect("looks down").horizontal_m()
                };
                let found = difference(at(h), at(-h), h);
                assert!(
                    (found - point.by_sensor.column(k)).norm() < 1e-6 * found.norm(),
                    "{k} {found}"
                );
            }
            for k in 0..6 {
                let h = 1e-5;
                let at = |s: f64| {
                    let mut by = Vector6::zeros();
                    by[k] = s;
                    let moved = sight.corrected(&by, Matrix6::zeros());
                    moved.ground(&camera, sensor).expect("looks down").horizontal_m()
                };
                let found = difference(at(h), at(-h), h);
                assert!(
                    (found - point.by_pose.column(k)).norm() < 1e-6 * (1.0 + found.norm()),
                    "{k} {found}"
                );
            }
        }
    }

    #[test]
    fn a_correction_turns_the_pose_about_north_east_and_down() {
        let mount = Mount::default();
        let by = Vector6::new(0.02, -0.01, 0.03, 1.0, 2.0, 3.0);
        let turned = Pose {
            attitude: UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.01, 0.03)) * tilted().attitude,
            position_m: [41.0, -23.0, 283.0],
            ..tilted()
        };
        let corrected = Sight::new(&tilted(), &mount).corrected(&by, Matrix6::zeros());
        let expected = Sight::new(&turned, &mount);
        assert!((corrected.to_world - expected.to_world).norm() < 1e-12);
        assert!((corrected.lens_m - expected.lens_m).norm() < 1e-12);
    }

    #[test]
    fn what_is_up_appears_farther_off_and_no_ray_meets_the_ground_at_the_horizon() {
        let camera = camera();
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0]);
        let sight = Sight::new(&pose, &Mount::default());
        // 20 m up and 125 m off nadir: 125·300/280.
        let seen = sight.apparent([125.0, 0.0, 20.0]).expect("below").horizontal_m();
        assert!((seen.x - 125.0 * 300.0 / 280.0).abs() < 1e-9);
        assert!(sight.apparent([10.0, 0.0, 301.0]).is_none());
        let over = Pose {
            attitude: UnitQuaternion::from_euler_angles(0.0, 1.5, 0.0),
            ..pose
        };
        let sight = Sight::new(&over, &Mount::default());
        assert!(sight.ground(&camera, [0.0, 0.01]).is_none());
        assert!(
            sight.sensor(&camera, [-100.0, 0.0, 300.0]).is_none()
                || sight.sensor(&camera, [0.0, -100.0, 300.0]).is_none()
        );
    }
}
