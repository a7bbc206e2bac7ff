//! What one autopilot says, as poses: which system it is, its clock, its attitude and its place.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3};

use super::clock::{Clock, Relation};
use super::frame::{Frame, Kind, Payload};
use super::refusal::Refusal;
use crate::geo::{self, LocalAxes};
use crate::platform::place::{Origin, Place, SeaLevelPlace};
use crate::pose::{PoseSigmas, attitude_of, swap_ned_enu};

/// A norm this far from 1 is no rounding of single precision: the message means something else.
const NORM_SLACK: f64 = 0.01;
/// How long ODOMETRY may be silent before the coarser messages are used, ns. At 30 Hz it is late by 15 samples.
const ODOMETRY_SILENT_NS: i64 = 500_000_000;
/// A place is carried on with its velocity for this long, s; at 1 m/s² of unknown acceleration that is 0.1 m.
const LONGEST_CARRY_S: f64 = 0.5;
/// No platform of ours is farther from where it started, m, or higher.
const FARTHEST_M: f64 = 1e6;
/// A variance beyond this says that nothing is known (1 rad; 1 km).
const LARGEST_VARIANCE: [f64; 2] = [1.0, 1e6];

pub(super) const AUTOPILOT_INVALID: u8 = 8;
const FRAME_LOCAL_NED: u8 = 1;
const FRAME_BODY_FRD: u8 = 12;
const GPS_FIX_3D: u8 = 3;

/// A pose as an autopilot states it.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// On our monotonic clock.
    pub time_ns: i64,
    pub attitude: UnitQuaternion<f64>,
    pub place: Place,
    /// As in [`crate::pose::Pose`].
    pub cov: Matrix6<f64>,
    pub kind: Kind,
}

/// What follows from a frame.
#[derive(Debug, PartialEq)]
pub enum Update {
    Pose(Box<Sample>),
    /// The system and component that are listened to from now on.
    Selected([u8; 2]),
    /// Something that a later pose needs, or nothing of interest.
    Other,
}

/// When a frame came in.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Our monotonic clock.
    pub now_ns: i64,
    /// Since 1970.
    pub unix_ns: i64,
}

#[derive(Clone, Copy, Debug)]
struct Fix {
    time_ns: i64,
    at: SeaLevelPlace,
    velocity_ned: [f64; 3],
}

/// Listens to one autopilot.
#[derive(Debug, Default)]
pub struct Vehicle {
    configured: Option<u8>,
    selected: Option<[u8; 2]>,
    pub clock: Clock,
    sigmas: PoseSigmas,
    odometry_ns: Option<i64>,
    origin: Option<SeaLevelPlace>,
    fix: Option<Fix>,
    undulation_m: Option<f64>,
    /// Horizontal and vertical, m.
    accuracy_m: Option<[f64; 2]>,
    heading_accuracy_rad: Option<f64>,
}

impl Vehicle {
    /// `configured` is the system id to listen to; without one it is that of the first autopilot that is heard. `sigmas` hold where the
    /// autopilot states none.
    pub fn new(configured: Option<u8>, sigmas: PoseSigmas) -> Self {
        Self {
            configured,
            sigmas,
            ..Self::default()
        }
    }

    /// The system and component that are listened to.
    pub fn id(&self) -> Option<[u8; 2]> {
        self.selected
    }

    /// Whether messages of this system may be of interest.
    pub fn may_take(&self, frame: &Frame) -> bool {
        match (self.selected, self.configured) {
            (Some(selected), _) => selected == [frame.system, frame.component],
            (None, Some(configured)) => frame.system == configured,
            (None, None) => true,
        }
    }

    pub fn relation(&self, now_ns: i64) -> Relation {
        self.clock.relation(now_ns)
    }

    /// Takes a frame whose checksum, system and signature are right.
    pub fn take(&mut self, frame: &Frame, moment: Moment) -> Result<Update, Refusal> {
        let p = frame.payload;
        if self.selected.is_none() {
            // A ground station or a camera sends heartbeats too, but no autopilot's.
            let is_autopilot = frame.kind == Kind::Heartbeat && p.u8(5) != AUTOPILOT_INVALID;
            if !is_autopilot {
                return Ok(Update::Other);
            }
            let id = [frame.system, frame.component];
            self.selected = Some(id);
            return Ok(Update::Selected(id));
        }
        match frame.kind {
            Kind::Timesync => {
                let (theirs, ours) = (p.i64(0), p.i64(8));
                // Zero is a question, not an answer.
                if theirs != 0 {
                    self.clock.answered(ours, theirs, moment.now_ns)?;
                }
            }
            Kind::GpsGlobalOrigin => self.origin = Some(geodetic(&p, 0).ok_or(Refusal::Position)?),
            Kind::GpsRawInt => self.take_gps(&p),
            Kind::GlobalPositionInt => self.take_fix(&p, moment)?,
            Kind::AttitudeQuaternion => return self.take_attitude(&p, moment),
            Kind::Odometry => return self.take_odometry(&p, moment),
            Kind::Heartbeat | Kind::CommandLong => {}
        }
        Ok(Update::Other)
    }

    /// What the extension fields add to a position; zero stands for "not known".
    fn take_gps(&mut self, p: &Payload) {
        if p.u8(28) < GPS_FIX_3D {
            return;
        }
        let (alt_mm, ellipsoid_mm) = (p.i32(16), p.i32(30));
        let metres = |at: usize| f64::from(p.u32(at)) * 1e-3;
        // Undulations lie between −107 m and 86 m.
        let undulation = (f64::from(ellipsoid_mm) - f64::from(alt_mm)) * 1e-3;
        self.undulation_m = (ellipsoid_mm != 0 && undulation.abs() < 150.0).then_some(undulation);
        let accuracy = [metres(34), metres(38)];
        let is_stated = accuracy.iter().all(|a| *a > 0.0 && a * a < LARGEST_VARIANCE[1]);
        self.accuracy_m = is_stated.then_some(accuracy);
        // Of the course over ground, unless the receiver has two antennas and gives a yaw.
        let heading = (f64::from(p.u32(46)) * 1e-5).to_radians();
        let has_yaw = !matches!(p.i16(50) as u16, 0 | u16::MAX);
        self.heading_accuracy_rad = (has_yaw && heading > 0.0 && heading < 1.0).then_some(heading);
    }

    fn take_fix(&mut self, p: &Payload, moment: Moment) -> Result<(), Refusal> {
        let time_ns = self.clock.time_of_ms(p.u32(0), moment.now_ns)?;
        let at = geodetic(p, 4).ok_or(Refusal::Position)?;
        self.fix = Some(Fix {
            time_ns,
            at,
            velocity_ned: [20, 22, 24].map(|at| f64::from(p.i16(at)) * 0.01),
        });
        Ok(())
    }

    fn take_attitude(&mut self, p: &Payload, moment: Moment) -> Result<Update, Refusal> {
        let time_ns = self.clock.time_of_ms(p.u32(0), moment.now_ns)?;
        if self
            .odometry_ns
            .is_some_and(|at| time_ns.saturating_sub(at) < ODOMETRY_SILENT_NS)
        {
            return Ok(Update::Other);
        }
        let attitude = attitude(p.floats(4))?;
        let place = self.carried(time_ns).ok_or(Refusal::Position)?;
        let mut cov = self.sigmas.cov();
        if let Some(sigma) = self.heading_accuracy_rad {
            cov[(2, 2)] = sigma * sigma;
        }
        self.put_accuracy(&mut cov);
        Ok(pose(time_ns, attitude, place, cov, Kind::AttitudeQuaternion))
    }

    fn take_odometry(&mut self, p: &Payload, moment: Moment) -> Result<Update, Refusal> {
        if p.u8(228) != FRAME_LOCAL_NED || p.u8(229) != FRAME_BODY_FRD {
            return Err(Refusal::Frame);
        }
        // A negative quality: the estimator has failed.
        if (p.u8(232) as i8) < 0 {
            return Err(Refusal::Position);
        }
        let time_ns = self.clock.time_of_us(p.u64(0), moment.now_ns, moment.unix_ns)?;
        let attitude = attitude(p.floats(20))?;
        let local: [f64; 3] = p.floats(8);
        if !local.iter().all(|v| v.abs() <= FARTHEST_M) {
            return Err(Refusal::Position);
        }
        let enu_m = swap_ned_enu(local.into()).into();
        let origin = self.origin.or_else(|| self.derived_origin(time_ns, enu_m));
        let place = Place {
            origin: origin.map_or(Origin::Unknown, Origin::Start),
            enu_m,
            undulation_m: self.undulation_m,
        };
        self.odometry_ns = Some(time_ns);
        let mut cov = self.sigmas.cov();
        self.put_accuracy(&mut cov);
        // The diagonal of x, y, z, roll, pitch, yaw; errors of the attitude are taken about the body's axes.
        let variances = [0, 6, 11, 15, 18, 20].map(|k| p.f32(60 + 4 * k));
        let stated = |k: usize, limit: f64| variances[k..k + 3].iter().all(|v| *v > 0.0 && *v < limit);
        if stated(3, LARGEST_VARIANCE[0]) {
            let turn = attitude.to_rotation_matrix();
            let body = Matrix3::from_diagonal(&Vector3::from_column_slice(&variances[3..]));
            let ned = turn * body * turn.transpose();
            cov.fixed_view_mut::<3, 3>(0, 0).copy_from(&ned);
        }
        if stated(0, LARGEST_VARIANCE[1]) {
            for (k, axis) in [(3, 1), (4, 0), (5, 2)] {
                cov[(k, k)] = variances[axis];
            }
        }
        Ok(pose(time_ns, attitude, place, cov, Kind::Odometry))
    }

    /// The last position, carried on with its velocity to `time_ns`.
    fn carried(&self, time_ns: i64) -> Option<Place> {
        let fix = self.fix?;
        let seconds = time_ns.saturating_sub(fix.time_ns) as f64 * 1e-9;
        let ned = Vector3::from(fix.velocity_ned) * seconds;
        (seconds.abs() <= LONGEST_CARRY_S).then(|| Place {
            origin: Origin::Passing(fix.at),
            enu_m: swap_ned_enu(ned).into(),
            undulation_m: self.undulation_m,
        })
    }

    /// Where the autopilot's local axes begin, by a position that it gives both ways.
    fn derived_origin(&self, time_ns: i64, enu_m: [f64; 3]) -> Option<SeaLevelPlace> {
        let place = self.carried(time_ns)?;
        let Origin::Passing(at) = place.origin else {
            return None;
        };
        let axes = LocalAxes::at(geo::Geodetic {
            latitude_deg: at.latitude_deg,
            longitude_deg: at.longitude_deg,
            height_m: at.sea_level_m,
        });
        let back = axes.to_geodetic([0, 1, 2].map(|k| place.enu_m[k] - enu_m[k]));
        Some(SeaLevelPlace {
            latitude_deg: back.latitude_deg,
            longitude_deg: back.longitude_deg,
            sea_level_m: back.height_m,
        })
    }

    fn put_accuracy(&self, cov: &mut Matrix6<f64>) {
        if let Some([horizontal, vertical]) = self.accuracy_m {
            for (k, sigma) in [(3, horizontal), (4, horizontal), (5, vertical)] {
                cov[(k, k)] = sigma * sigma;
            }
        }
    }
}

fn pose(time_ns: i64, attitude: UnitQuaternion<f64>, place: Place, cov: Matrix6<f64>, kind: Kind) -> Update {
    Update::Pose(Box::new(Sample {
        time_ns,
        attitude,
        place,
        cov,
        kind,
    }))
}

fn attitude(q: [f64; 4]) -> Result<UnitQuaternion<f64>, Refusal> {
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !((norm - 1.0).abs() <= NORM_SLACK) {
        return Err(Refusal::Attitude);
    }
    attitude_of(q).map_err(|_| Refusal::Attitude)
}

/// Latitude and longitude in 10⁻⁷ degrees and height in mm, as three integers. Zero and zero stand for "none yet".
fn geodetic(p: &Payload, at: usize) -> Option<SeaLevelPlace> {
    let [latitude, longitude, height] = [0, 4, 8].map(|k| f64::from(p.i32(at + k)));
    let found = SeaLevelPlace {
        latitude_deg: latitude * 1e-7,
        longitude_deg: longitude * 1e-7,
        sea_level_m: height * 1e-3,
    };
    let is_place = found.latitude_deg.abs() <= 90.0 && found.longitude_deg.abs() <= 180.0;
    (is_place && (latitude != 0.0 || longitude != 0.0)).then_some(found)
}

#[cfg(test)]
#[path = "vehicle_test.rs"]
mod tests;
