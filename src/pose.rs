//! The platform's position and attitude at a time, with covariance, and the small rotations by which attitudes differ.
//!
//! World axes are local east, north, up; body axes forward, right, down; attitudes rotate body vectors into north, east, down.

use jiff::Timestamp;
use nalgebra::{Matrix6, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Where the platform was and how it was turned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "PoseRecord", try_from = "PoseRecord")]
pub struct Pose {
    pub time: Timestamp,
    /// The lens: east, north, up of the world's origin, m.
    pub position_m: [f64; 3],
    /// Body (forward, right, down) to north, east, down.
    pub attitude: UnitQuaternion<f64>,
    /// Covariance of the rotation vector that turns `attitude` into the true one, about north, east, down (rad), then of the
    /// position, east, north, up (m).
    pub cov: Matrix6<f64>,
}

/// A pose as recordings hold it: a line of a poses file with its whole covariance.
#[derive(Clone, Debug, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedPose)]
#[serde(deny_unknown_fields)]
pub struct PoseRecord {
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    x_m: f64,
    y_m: f64,
    z_m: f64,
    /// Body (forward, right, down) to north, east, down: w, x, y, z.
    q: [f64; 4],
    /// Upper triangle, row by row, of the covariance of attitude (about north, east, down, rad) and position (east, north, up, m).
    cov: Vec<f64>,
}

/// Why a record is no pose.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RecordError {
    #[error("field `q`: {0}")]
    Attitude(#[from] AttitudeError),
    #[error("expected finite coordinates")]
    Place,
    #[error("field `cov`: expected the {COV_LEN} numbers of a covariance's upper triangle")]
    Cov,
}

/// Numbers of the upper triangle of a 6 × 6 matrix.
const COV_LEN: usize = 21;

fn upper_triangle() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|row| (row..6).map(move |column| (row, column)))
}

impl From<Pose> for PoseRecord {
    fn from(pose: Pose) -> Self {
        let [x_m, y_m, z_m] = pose.position_m;
        let q = pose.attitude.quaternion();
        Self {
            time: pose.time,
            x_m,
            y_m,
            z_m,
            q: [q.w, q.i, q.j, q.k],
            cov: upper_triangle().map(|at| pose.cov[at]).collect(),
        }
    }
}

impl TryFrom<PoseRecord> for Pose {
    type Error = RecordError;

    fn try_from(record: PoseRecord) -> Result<Self, RecordError> {
        /// Departure of a unit quaternion's squared norm from one by rounding.
        const ROUNDING: f64 = 1e-14;
        let position_m = [record.x_m, record.y_m, record.z_m];
        if position_m.iter().any(|v| !v.is_finite()) {
            return Err(RecordError::Place);
        }
        let [w, i, j, k] = record.q;
        let quaternion = Quaternion::new(w, i, j, k);
        // To be normalised again would change the last bits, and with them what a review of the recording says.
        let attitude = match (quaternion.norm_squared() - 1.0).abs() <= ROUNDING {
            true => UnitQuaternion::new_unchecked(quaternion),
            false => attitude_of(record.q)?,
        };
        let mut cov = Matrix6::zeros();
        for ((row, column), value) in upper_triangle().zip(&record.cov) {
            cov[(row, column)] = *value;
            cov[(column, row)] = *value;
        }
        let is_cov = cov.iter().all(|v| v.is_finite()) && cov.diagonal().iter().all(|v| *v >= 0.0);
        if record.cov.len() != COV_LEN || !is_cov {
            return Err(RecordError::Cov);
        }
        Ok(Self {
            time: record.time,
            position_m,
            attitude,
            cov,
        })
    }
}

/// Standard deviations of a pose whose errors are alike along all axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSigmas {
    /// About each axis, rad.
    pub attitude_rad: f64,
    /// Along each axis, m.
    pub position_m: f64,
}

/// For a source that states none: what small autopilots reach in tilt (Madgwick 2010 and PX4 logs: 1° and less), and a GNSS
/// receiver without corrections (horizontal 1 to 2 m). Smaller alerts honest users, larger hides small displacements.
impl Default for PoseSigmas {
    fn default() -> Self {
        Self {
            attitude_rad: 0.01,
            position_m: 2.0,
        }
    }
}

impl PoseSigmas {
    /// The covariance of a pose with these errors, independent of each other.
    pub fn cov(self) -> Matrix6<f64> {
        let (a, p) = (self.attitude_rad.powi(2), self.position_m.powi(2));
        Matrix6::from_diagonal(&[a, a, a, p, p, p].into())
    }
}

/// Why four numbers are no attitude.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum AttitudeError {
    #[error("expected four finite numbers")]
    NotFinite,
    #[error("expected a quaternion that is not zero, found norm {0}")]
    Norm(f64),
}

/// The unit quaternion of [w, x, y, z], of whatever norm but zero.
pub fn attitude_of(q: [f64; 4]) -> Result<UnitQuaternion<f64>, AttitudeError> {
    if q.iter().any(|v| !v.is_finite()) {
        return Err(AttitudeError::NotFinite);
    }
    let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
    let norm = quaternion.norm();
    if !(1e-6..1e6).contains(&norm) {
        return Err(AttitudeError::Norm(norm));
    }
    Ok(UnitQuaternion::new_normalize(quaternion))
}

/// A vector in north, east, down as east, north, up, and back: the map is its own inverse.
pub fn swap_ned_enu(v: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(v.y, v.x, -v.z)
}

/// The rotation vector δ with `to = exp(δ)·from`: about the fixed axes, rad, at most π long.
pub fn rotation_between(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Vector3<f64> {
    (to * from.inverse()).scaled_axis()
}

/// The camera's attitude in the body: turned by yaw about body down, then pitch about the new right, then roll about the new
/// forward. With all zero the camera looks along body down, its sensor's +y along body forward.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mount {
    pub roll_deg: f64,
    pub pitch_deg: f64,
    pub yaw_deg: f64,
}

impl Mount {
    /// Camera (sensor +y, sensor +x, optical axis) to body (forward, right, down).
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        let [roll, pitch, yaw] = [self.roll_deg, self.pitch_deg, self.yaw_deg].map(f64::to_radians);
        UnitQuaternion::from_euler_angles(roll, pitch, yaw)
    }

    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl Pose {
    /// Level and heading north at a place, known exactly.
    pub fn level(time: Timestamp, position_m: [f64; 3]) -> Self {
        Self {
            time,
            position_m,
            attitude: UnitQuaternion::identity(),
            cov: Matrix6::zeros(),
        }
    }

    /// The pose at a `share` (0 to 1) of the way to `next`: the attitude by slerp (Shoemake 1985), position and covariance
    /// linearly. Shares beyond 1 go on at the same rate; the covariance is then the later pose's.
    pub fn towards(&self, next: &Self, share: f64, time: Timestamp) -> Self {
        let turn = rotation_between(&self.attitude, &next.attitude) * share;
        let between = |k: usize| self.position_m[k] + (next.position_m[k] - self.position_m[k]) * share;
        let weight = share.clamp(0.0, 1.0);
        Self {
            time,
            position_m: [0, 1, 2].map(between),
            attitude: UnitQuaternion::from_scaled_axis(turn) * self.attitude,
            cov: self.cov * (1.0 - weight) + next.cov * weight,
        }
    }

    /// Heading: the angle of body forward from north, clockwise, rad.
    pub fn heading_rad(&self) -> f64 {
        self.attitude.euler_angles().2
    }

    /// Roll, pitch and yaw (heading), rad, applied in the order yaw, pitch, roll.
    pub fn euler_rad(&self) -> [f64; 3] {
        self.attitude.euler_angles().into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_turned_by_a_quarter_has_the_sensor_s_y_along_body_right() {
        let mount = |roll_deg, pitch_deg, yaw_deg| {
            let mount = Mount {
                roll_deg,
                pitch_deg,
                yaw_deg,
            };
            mount.rotation()
        };
        let near = |a: Vector3<f64>, b: [f64; 3]| assert!((a - Vector3::from(b)).norm() < 1e-12, "{a} {b:?}");
        near(mount(0.0, 0.0, 90.0) * Vector3::x(), [0.0, 1.0, 0.0]);
        // Pitched up, the optical axis tilts forward; rolled right, it tilts to the left.
        near(mount(0.0, 90.0, 0.0) * Vector3::z(), [1.0, 0.0, 0.0]);
        near(mount(90.0, 0.0, 0.0) * Vector3::z(), [0.0, -1.0, 0.0]);
        // Yaw first, then pitch about the new right axis.
        near(mount(0.0, 90.0, 90.0) * Vector3::z(), [0.0, 1.0, 0.0]);
    }

    #[test]
    fn between_two_poses_the_turn_is_uniform_and_takes_the_short_way() {
        let mut a = Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, 300.0]);
        let mut b = a.clone();
        a.attitude = UnitQuaternion::from_euler_angles(0.0, 0.0, 170f64.to_radians());
        b.attitude = UnitQuaternion::from_euler_angles(0.0, 0.0, -170f64.to_radians());
        b.position_m = [4.0, 8.0, 304.0];
        b.cov = PoseSigmas::default().cov();
        let middle = a.towards(&b, 0.25, Timestamp::UNIX_EPOCH);
        assert!((middle.heading_rad() - 175f64.to_radians()).abs() < 1e-12);
        assert_eq!(middle.position_m, [1.0, 2.0, 301.0]);
        assert!((middle.cov[(5, 5)] - 1.0).abs() < 1e-12);
        let beyond = a.towards(&b, 2.0, Timestamp::UNIX_EPOCH);
        assert!((beyond.heading_rad() + 150f64.to_radians()).abs() < 1e-12);
        assert_eq!(beyond.cov, b.cov);
    }

    #[test]
    fn a_recorded_pose_is_the_same_to_the_bit_and_a_wrong_one_is_refused() {
        for k in 0..100 {
            let angle = 0.1 * f64::from(k);
            let mut pose = Pose::level(
                "2026-11-21T08:00:00.1234567Z".parse().unwrap(),
                [0.1, -2.0 / 3.0, 300.0],
            );
            pose.attitude = UnitQuaternion::from_euler_angles(angle, 0.3 * angle, 1.0 / 3.0);
            pose.cov = PoseSigmas::default().cov();
            pose.cov[(0, 4)] = 1e-3 * angle;
            pose.cov[(4, 0)] = 1e-3 * angle;
            let line = serde_json::to_string(&pose).unwrap();
            assert_eq!(serde_json::from_str::<Pose>(&line).unwrap(), pose, "{line}");
        }
        let line = serde_json::to_string(&Pose::level(Timestamp::UNIX_EPOCH, [0.0; 3])).unwrap();
        for (from, to) in [
            ("\"q\":[1.0", "\"q\":[0.0"),
            ("\"cov\":[0.0", "\"cov\":[-1.0"),
            ("\"cov\":[0.0,", "\"cov\":["),
        ] {
            assert!(line.contains(from), "{line}");
            assert!(
                serde_json::from_str::<Pose>(&line.replacen(from, to, 1)).is_err(),
                "{to}"
            );
        }
    }

    #[test]
    fn what_is_no_attitude_is_refused() {
        assert!(attitude_of([1.0, 0.0, 0.0, 1e-3]).is_ok());
        assert_eq!(attitude_of([f64::NAN, 0.0, 0.0, 0.0]), Err(AttitudeError::NotFinite));
        assert_eq!(attitude_of([0.0; 4]), Err(AttitudeError::Norm(0.0)));
    }
}
