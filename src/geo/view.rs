//! What the camera sees of the world in one frame: from a fixed, level platform by the camera's own map, else by a sight.

use nalgebra::{Matrix2, Matrix2x6, Vector2};

use super::pose_error::PoseError;
use super::sight::Sight;
use crate::optics::Camera;

/// The camera, and where it is and looks where that is not level over (0, 0) at its own altitude.
#[derive(Clone, Debug)]
pub struct View {
    pub camera: Camera,
    pub sight: Option<Sight>,
}

/// A spot placed on the ground.
#[derive(Clone, Copy, Debug)]
pub struct Placed {
    /// East, north, m.
    pub position_m: Vector2<f64>,
    /// Height of the ground there above the world's origin, m.
    pub z_m: f64,
    /// Without the pose's error, m².
    pub cov_m2: [[f64; 2]; 2],
    /// ∂position/∂pose, as [`GroundPoint::by_pose`](super::GroundPoint); zero for a fixed platform.
    pub by_pose: Matrix2x6<f64>,
}

impl View {
    /// Places a spot that a level camera at its own altitude would see at `level_m`, m, with the covariance `level_cov`, m²;
    /// `None` where its ray meets no ground that is known.
    pub fn place(&self, sensor_m: [f64; 2], level_m: [f64; 2], level_cov: [[f64; 2]; 2]) -> Option<Placed> {
        let Some(sight) = &self.sight else {
            return Some(Placed {
                position_m: level_m.into(),
                z_m: 0.0,
                cov_m2: level_cov,
                by_pose: Matrix2x6::zeros(),
            });
        };
        let point = sight.ground(&self.camera, sensor_m)?;
        let [[a, b], [_, c]] = self.camera.cov_to_sensor(sensor_m, level_cov);
        let cov = point.by_sensor * Matrix2::new(a, b, b, c) * point.by_sensor.transpose();
        Some(Placed {
            position_m: point.horizontal_m(),
            z_m: point.position_m.z,
            cov_m2: [[cov[(0, 0)], cov[(0, 1)]], [cov[(0, 1)], cov[(1, 1)]]],
            by_pose: point.by_pose,
        })
    }

    /// That of a fixed, level platform.
    pub fn level(camera: &Camera) -> Self {
        Self {
            camera: camera.clone(),
            sight: None,
        }
    }

    /// The sensor position, m, of a place on the ground, m; infinite behind the camera and off the map. In a void about that.
    pub fn to_sensor(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let Some(sight) = &self.sight else {
            return self.camera.to_sensor([x, y]);
        };
        let seen = sight.ground_about([x, y]);
        let seen = seen.and_then(|ground| sight.sensor(&self.camera, [x, y, ground.z_m]));
        seen.unwrap_or([f64::INFINITY; 2])
    }

    /// Where on the ground a beam from a place appears to come from, m; the place itself where it is on the ground (without `z_m`)
    /// or no ray from it comes down.
    pub fn apparent(&self, x_m: f64, y_m: f64, z_m: Option<f64>) -> Vector2<f64> {
        let place = Vector2::new(x_m, y_m);
        if let (Some(sight), Some(z_m)) = (&self.sight, z_m)
            && sight.has_terrain()
        {
            let seen = sight.apparent([x_m, y_m, z_m]);
            return seen.map_or(place, |point| point.horizontal_m());
        }
        let Some(z_m) = z_m.filter(|z| *z != 0.0) else {
            return place;
        };
        let height_m = self.height_m();
        if !(z_m < height_m) {
            return place;
        }
        let nadir = self.nadir_m();
        nadir + (place - nadir) * (height_m / (height_m - z_m))
    }

    /// The lens above the ground below it, m; above z = 0 where the ground's height is not known.
    pub fn height_m(&self) -> f64 {
        self.sight.as_ref().map_or(self.camera.altitude_m, Sight::height_m)
    }

    /// The height of the ground at a place, m; `None` where it is not known.
    pub fn ground_z_m(&self, p: Vector2<f64>) -> Option<f64> {
        match &self.sight {
            None => Some(0.0),
            Some(sight) => sight.ground_below(p.into()).map(|ground| ground.z_m),
        }
    }

    /// Whether the ground's height is known at a place and around it: a beam from elsewhere has no place.
    pub fn is_ground_known(&self, p: Vector2<f64>, around_m: f64) -> bool {
        const AROUND: [[f64; 2]; 9] = [
            [0.0, 0.0],
            [1.0, 0.0],
            [-1.0, 0.0],
            [0.0, 1.0],
            [0.0, -1.0],
            [0.7, 0.7],
            [-0.7, 0.7],
            [0.7, -0.7],
            [-0.7, -0.7],
        ];
        let is_known = |[x, y]: [f64; 2]| self.ground_z_m(p + Vector2::new(x, y) * around_m).is_some();
        !self.sight.as_ref().is_some_and(Sight::has_terrain) || AROUND.into_iter().all(is_known)
    }

    /// The place below the lens, m.
    pub fn nadir_m(&self) -> Vector2<f64> {
        self.sight.as_ref().map_or(Vector2::zeros(), |s| s.lens_m().xy())
    }

    /// ln of the geometric gain of a beam from the ground at a place, but for a constant: the lens's area as the beam sees it over the squared
    /// distance, by which a beam that is wider than the lens is collected; `None` behind the camera.
    pub fn ln_gain(&self, p: Vector2<f64>) -> Option<f64> {
        let (depth_m, distance_m) = match &self.sight {
            None => (self.camera.altitude_m, self.camera.altitude_m.hypot(p.norm())),
            Some(sight) => sight.depth_and_distance_m([p.x, p.y, self.ground_z_m(p).unwrap_or(0.0)]),
        };
        (depth_m > 0.0).then(|| (depth_m / distance_m.powi(3)).ln())
    }

    /// Ground metres per sensor metre straight below.
    pub fn ground_scale(&self) -> f64 {
        match &self.sight {
            None => self.camera.ground_scale(),
            Some(sight) => sight.ground_scale(&self.camera),
        }
    }

    /// The ground in the middle of the view and at its four edges, m; those that there are.
    pub fn middle_and_edges_m(&self) -> Vec<Vector2<f64>> {
        let camera = &self.camera;
        let corners = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]];
        match &self.sight {
            None => {
                let [w, h] = [&camera.x, &camera.y].map(|axis| axis.half_width() * camera.ground_scale());
                corners.map(|[x, y]| Vector2::new(x * w, y * h)).to_vec()
            }
            Some(sight) => {
                let sensor = corners.map(|[x, y]| [x * camera.x.half_width(), y * camera.y.half_width()]);
                let points = sensor.into_iter().filter_map(|s| sight.ground(camera, s));
                points.map(|p| p.horizontal_m()).collect()
            }
        }
    }

    /// Outline of the view on the ground, east, north and up, m, counter-clockwise; without the parts whose rays meet no ground.
    pub fn outline_m(&self) -> Vec<[f64; 3]> {
        /// Points of an edge: a distorted one is a curve.
        const OF_AN_EDGE: usize = 4;
        let half = [self.camera.x.half_width(), self.camera.y.half_width()];
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let on_ground = |[x, y]: [f64; 2]| {
            let sensor = [x * half[0], y * half[1]];
            match &self.sight {
                None => {
                    let [x, y] = self.camera.to_ground(sensor);
                    Some([x, y, 0.0])
                }
                Some(sight) => sight.ground(&self.camera, sensor).map(|point| point.position_m.into()),
            }
        };
        let points = (0..4 * OF_AN_EDGE).filter_map(|k| {
            let (from, to) = (corners[k / OF_AN_EDGE], corners[(k / OF_AN_EDGE + 1) % 4]);
            let share = (k % OF_AN_EDGE) as f64 / OF_AN_EDGE as f64;
            on_ground([0, 1].map(|i| from[i] + share * (to[i] - from[i])))
        });
        points.collect()
    }

    /// ∂place/∂pose of a place on the ground, as [`GroundPoint::by_pose`](super::GroundPoint) has it; zero for a fixed platform.
    pub fn by_pose(&self, p: Vector2<f64>) -> Matrix2x6<f64> {
        let point = self.sight.as_ref().and_then(|s| s.ground_at(p.into()));
        point.map_or(Matrix2x6::zeros(), |point| point.by_pose)
    }

    /// Where a beam from a place on the ground, m, appears to come from because the pose is off by `error` (as
    /// [`Sight::corrected`] has it); there itself for a fixed platform.
    pub fn displaced(&self, p: Vector2<f64>, error: &PoseError) -> Vector2<f64> {
        let Some(sight) = &self.sight else {
            return p;
        };
        let seen = sight.seen_with_error(p.into(), error);
        seen.map_or(p, |point| point.horizontal_m())
    }

    /// The place on the ground, m, of a beam that appears to come from `seen` because the pose is off by `error`.
    pub fn undisplaced(&self, seen: Vector2<f64>, error: &PoseError) -> Vector2<f64> {
        let Some(sight) = &self.sight else {
            return seen;
        };
        let place = sight.seen_without_error(seen.into(), error);
        place.map_or(seen, |point| point.horizontal_m())
    }

    /// Covariance that the pose's error makes of a place on the ground, m²; zero for a fixed platform.
    pub fn pose_cov(&self, p: Vector2<f64>) -> Matrix2<f64> {
        self.sight.as_ref().map_or(Matrix2::zeros(), |sight| {
            let by_pose = self.by_pose(p);
            by_pose * sight.cov() * by_pose.transpose()
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use jiff::Timestamp;
    use nalgebra::{UnitQuaternion, Vector6};

    use super::*;
    use crate::geo::Terrain;
    use crate::optics;
    use crate::pose::{Mount, Pose};

    #[test]
    fn an_error_of_the_pose_displaces_what_it_makes_of_a_spot() {
        let camera = optics::Config::default().camera().unwrap();
        let pose = Pose {
            attitude: UnitQuaternion::from_euler_angles(0.1, -0.08, 1.2),
            ..Pose::level(Timestamp::UNIX_EPOCH, [30.0, -20.0, camera.altitude_m])
        };
        let sight = Sight::new(&pose, &Mount::default());
        let error = Vector6::new(0.01, -0.02, 0.1, 2.0, -1.0, 3.0);
        let truth = sight.corrected(&-error, *sight.cov());
        let by = PoseError::of(error);
        let view = View {
            camera: camera.clone(),
            sight: Some(sight.clone()),
        };
        for spot in [[0.0, 0.0], [5e-3, -3e-3], [-8e-3, 6e-3]] {
            let [place, seen] = [&truth, &sight].map(|s| s.ground(&camera, spot).unwrap().horizontal_m());
            assert!((view.displaced(place, &by) - seen).norm() < 1e-9);
            assert!((view.undisplaced(seen, &by) - place).norm() < 1e-9);
            // A tenth of a radian is no small heading error.
            let linear = view.by_pose(place) * error;
            assert!((place + linear - seen).norm() > 0.1);
        }
        let level = View::level(&camera);
        let p = Vector2::new(3.0, 4.0);
        assert_eq!((level.displaced(p, &by), level.undisplaced(p, &by)), (p, p));
    }

    #[test]
    fn who_is_in_a_void_or_beside_one_is_in_view_and_need_not_be_seen() {
        let camera = optics::Config::default().camera().unwrap();
        let pose = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 400.0]);
        let ground = Terrain::sampled(
            100,
            5.0,
            |x, y| if (x - 40.0).hypot(y) < 7.0 { f64::NAN } else { 100.0 },
        );
        let view = View {
            sight: Some(Sight::new(&pose, &Mount::default()).over(Some(Arc::new(ground)))),
            camera: camera.clone(),
        };
        let place = |x: f64| Vector2::new(x, 0.0);
        // 300 m above the ground below the lens.
        let shown = view.to_sensor([40.0, 0.0]);
        assert!(
            (shown[1].hypot(shown[0]) - 40.0 * camera.plane_distance_m / 300.0).abs() < 1e-12,
            "{shown:?}"
        );
        assert!(!view.is_ground_known(place(40.0), 0.0) && !view.is_ground_known(place(25.0), 10.0));
        assert!(view.is_ground_known(place(25.0), 1.0) && View::level(&camera).is_ground_known(place(40.0), 10.0));
    }

    #[test]
    fn a_beam_is_collected_by_the_lens_as_it_sees_it() {
        let camera = optics::Config::default().camera().unwrap();
        let h = camera.altitude_m;
        let level = View::level(&camera);
        let of = |z_m: f64, pitch: f64| {
            let mut pose = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, z_m]);
            pose.attitude = UnitQuaternion::from_euler_angles(0.0, pitch, 0.0);
            let sight = Some(Sight::new(&pose, &Mount::default()));
            let camera = camera.clone();
            View { camera, sight }
        };
        let [below, aside] = [Vector2::zeros(), Vector2::new(0.0, h)];
        for p in [below, aside] {
            let gains = [&level, &of(h, 0.0)].map(|view| view.ln_gain(p).unwrap());
            assert!((gains[0] - gains[1]).abs() < 1e-9, "{gains:?}");
        }
        // Half as far is four times as much; at 45 degrees twice the squared distance, and the lens foreshortened by 1/√2.
        let over = |view: &View, p| view.ln_gain(p).unwrap() - level.ln_gain(below).unwrap();
        assert!((over(&of(0.5 * h, 0.0), below) - 4f64.ln()).abs() < 1e-9);
        assert!((over(&level, aside) + 1.5 * 2f64.ln()).abs() < 1e-9);
        assert!((over(&of(h, 0.6), below) - 0.6f64.cos().ln()).abs() < 1e-9);
        assert_eq!(of(h, 2.0).ln_gain(below), None, "behind the camera");
    }

    #[test]
    fn the_outline_is_the_view_s_corners_and_ends_where_the_sky_begins() {
        let camera = optics::Config::default().camera().unwrap();
        let level = View::level(&camera).outline_m();
        let [w, h] = camera.to_ground([camera.x.half_width(), camera.y.half_width()]);
        let corner = |k: usize| [level[4 * k][0], level[4 * k][1]];
        let expected = [[-w, -h], [w, -h], [w, h], [-w, h]];
        for (k, at) in expected.iter().enumerate() {
            assert!((corner(k)[0] - at[0]).hypot(corner(k)[1] - at[1]) < 1e-9, "{level:?}");
        }
        let seen = |pitch_deg: f64| {
            let mut pose = Pose::level(Timestamp::UNIX_EPOCH, [1000.0, 0.0, camera.altitude_m]);
            pose.attitude = UnitQuaternion::from_euler_angles(0.0, pitch_deg.to_radians(), 0.0);
            let sight = Some(Sight::new(&pose, &Mount::default()));
            let camera = camera.clone();
            View { camera, sight }.outline_m()
        };
        // Pitched up, the view moves north (forward) and grows there.
        let tilted = seen(20.0);
        assert_eq!(tilted.len(), level.len());
        assert!((tilted[0][0] + tilted[4][0] - 2000.0).abs() < 1e-6, "{tilted:?}");
        assert!(tilted[0][1] > level[0][1] && tilted[8][1] > level[8][1] && tilted[8][0] - 1000.0 > w);
        let horizon = seen(80.0);
        assert!(!horizon.is_empty() && horizon.len() < level.len(), "{horizon:?}");
    }
}
