//! What the outside sees of the pose and of the ground that the camera sees.

use jiff::Timestamp;

use crate::api::{PoseNow, PoseStatus, ViewStatus};
use crate::geo::{LocalAxes, View};
use crate::metric;
use crate::optics::Camera;
use crate::platform::{self, Placement, PoseAt};
use crate::pose::Pose;

/// Says where the platform is, frame by frame.
pub struct Poses {
    source: &'static str,
    axes: Option<LocalAxes>,
    /// Of the camera where it looked in the latest frame.
    view: View,
    latest: PoseStatus,
}

impl Poses {
    pub fn new(config: &platform::Config, axes: Option<LocalAxes>, camera: &Camera) -> Self {
        let source = config.kind.name();
        Self {
            source,
            axes,
            view: View::level(camera),
            latest: PoseStatus {
                source: source.into(),
                time: Timestamp::UNIX_EPOCH,
                is_lost: false,
                pose: None,
            },
        }
    }

    pub fn latest(&self) -> PoseStatus {
        self.latest.clone()
    }

    /// What the camera saw of the ground; nothing as long as no pose has come.
    pub fn view(&self) -> Option<ViewStatus> {
        let pose = self.latest.pose.as_ref()?;
        let outline = self.view.outline_m();
        Some(ViewStatus {
            footprint_m: outline.iter().map(|[x, y, _]| [*x, *y]).collect(),
            footprint_z_m: outline.iter().map(|[_, _, z]| *z).collect(),
            nadir_m: [pose.x_m, pose.y_m],
            z_m: pose.z_m,
            heading_deg: pose.heading_deg,
            roll_deg: pose.roll_deg,
            pitch_deg: pose.pitch_deg,
            pose_age_s: pose.age_s,
        })
    }

    /// Takes where the camera was in the frame of `time`.
    pub fn update(&mut self, time: Timestamp, placement: &Placement) {
        let (pose, is_lost) = match placement {
            Placement::Level => (
                Some(self.now(&Pose::level(time, [0.0, 0.0, self.view.camera.altitude_m]), 0.0)),
                false,
            ),
            Placement::At { pose, is_lost, sight } => {
                self.view.sight = Some(sight.clone());
                let PoseAt { pose, age_s, .. } = &**pose;
                metrics::gauge!(metric::POSE_AGE).set(*age_s);
                (Some(self.now(pose, *age_s)), *is_lost)
            }
            Placement::Unknown { waited_s, is_lost } => {
                metrics::gauge!(metric::POSE_AGE).set(*waited_s);
                (None, *is_lost)
            }
        };
        self.latest = PoseStatus {
            source: self.source.into(),
            time,
            is_lost,
            pose,
        };
    }

    fn now(&self, pose: &Pose, age_s: f64) -> PoseNow {
        let [roll, pitch, yaw] = pose.euler_rad();
        let [x_m, y_m, z_m] = pose.position_m;
        let q = pose.attitude.quaternion();
        let place = self.axes.map(|axes| axes.to_geodetic(pose.position_m));
        PoseNow {
            age_s,
            x_m,
            y_m,
            z_m,
            latitude_deg: place.map(|p| p.latitude_deg),
            longitude_deg: place.map(|p| p.longitude_deg),
            height_m: place.map(|p| p.height_m),
            q: [q.w, q.i, q.j, q.k],
            roll_deg: roll.to_degrees(),
            pitch_deg: pitch.to_degrees(),
            heading_deg: yaw.to_degrees().rem_euclid(360.0),
            cov: std::array::from_fn(|i| std::array::from_fn(|j| pose.cov[(i, j)])),
        }
    }
}
