//! Telemetry of made-up vehicles, message by message.

use super::super::frame::{Found, build, read};
use super::*;

const S: i64 = 1_000_000_000;

/// Fields at their offsets, little-endian.
#[derive(Clone)]
struct Fields(Vec<u8>);

impl Fields {
    fn new(kind: Kind) -> Self {
        Self(vec![0; kind.definition().2 + 32])
    }

    fn put<const N: usize>(mut self, at: usize, bytes: [u8; N]) -> Self {
        self.0[at..at + N].copy_from_slice(&bytes);
        self
    }

    fn floats(self, at: usize, values: &[f32]) -> Self {
        let put = |fields: Self, (k, value): (usize, &f32)| fields.put(at + 4 * k, value.to_le_bytes());
        values.iter().enumerate().fold(self, put)
    }
}

fn take_from(vehicle: &mut Vehicle, id: [u8; 2], kind: Kind, fields: &Fields, now_ns: i64) -> Result<Update, Refusal> {
    let bytes = build(kind, id, 0, &fields.0, false);
    let Found::Frame(frame) = read(&bytes).1 else {
        panic!("a frame of ours");
    };
    if !vehicle.may_take(&frame) {
        return Err(Refusal::OtherSystem);
    }
    vehicle.take(
        &frame,
        Moment {
            now_ns,
            unix_ns: now_ns,
        },
    )
}

fn take(vehicle: &mut Vehicle, kind: Kind, fields: &Fields, now_ns: i64) -> Result<Update, Refusal> {
    take_from(vehicle, [1, 1], kind, fields, now_ns)
}

fn heartbeat(autopilot: u8) -> Fields {
    Fields::new(Kind::Heartbeat).put(4, [2, autopilot])
}

fn listening() -> Vehicle {
    let mut vehicle = Vehicle::new(None, PoseSigmas::default());
    let update = take(&mut vehicle, Kind::Heartbeat, &heartbeat(12), S);
    assert_eq!(update, Ok(Update::Selected([1, 1])));
    vehicle
}

fn odometry(time_us: u64, q: [f32; 4]) -> Fields {
    let fields = Fields::new(Kind::Odometry).put(0, time_us.to_le_bytes());
    fields.floats(8, &[10.0, 20.0, -30.0]).floats(20, &q).put(228, [1, 12])
}

fn attitude_quaternion(time_ms: u32, q: [f32; 4]) -> Fields {
    Fields::new(Kind::AttitudeQuaternion)
        .put(0, time_ms.to_le_bytes())
        .floats(4, &q)
}

fn global_position(time_ms: u32, north_cm_s: i16) -> Fields {
    let fields = Fields::new(Kind::GlobalPositionInt).put(0, time_ms.to_le_bytes());
    let fields = fields
        .put(4, 481_370_000i32.to_le_bytes())
        .put(8, 115_750_000i32.to_le_bytes());
    fields
        .put(12, 520_000i32.to_le_bytes())
        .put(20, north_cm_s.to_le_bytes())
}

fn sample(update: Result<Update, Refusal>) -> Sample {
    match update {
        Ok(Update::Pose(sample)) => *sample,
        other => panic!("{other:?}"),
    }
}

const LEVEL: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

#[test]
fn the_first_autopilot_is_listened_to_and_no_other() {
    let mut vehicle = Vehicle::new(None, PoseSigmas::default());
    // A ground station, then the autopilot, then another.
    assert_eq!(
        take_from(&mut vehicle, [255, 190], Kind::Heartbeat, &heartbeat(8), S),
        Ok(Update::Other)
    );
    let first = take_from(&mut vehicle, [3, 1], Kind::Heartbeat, &heartbeat(3), S);
    assert_eq!(first, Ok(Update::Selected([3, 1])));
    for other in [[4, 1], [3, 197]] {
        let update = take_from(&mut vehicle, other, Kind::Odometry, &odometry(1, LEVEL), S);
        assert_eq!(update, Err(Refusal::OtherSystem));
    }
    let mut vehicle = Vehicle::new(Some(4), PoseSigmas::default());
    let update = take_from(&mut vehicle, [3, 1], Kind::Heartbeat, &heartbeat(3), S);
    assert_eq!(update, Err(Refusal::OtherSystem));
}

#[test]
fn what_is_no_rotation_is_refused() {
    let mut vehicle = listening();
    for q in [
        [0.0; 4],
        [f32::NAN, 0.0, 0.0, 0.0],
        [1.0, f32::INFINITY, 0.0, 0.0],
        [2.0, 0.0, 0.0, 0.0],
    ] {
        assert_eq!(
            take(&mut vehicle, Kind::Odometry, &odometry(1_000_000, q), S),
            Err(Refusal::Attitude)
        );
    }
    let found = sample(take(&mut vehicle, Kind::Odometry, &odometry(1_000_000, LEVEL), S));
    assert_eq!(
        (found.place.origin, found.place.enu_m),
        (Origin::Unknown, [20.0, 10.0, 30.0])
    );
    assert_eq!(found.cov, PoseSigmas::default().cov(), "zeros state nothing");
}

#[test]
fn only_positions_in_axes_that_are_known_are_taken() {
    let mut vehicle = listening();
    // MAV_FRAME_LOCAL_FRD: which way its x points is not said.
    let turned = odometry(1_000_000, LEVEL).put(228, [20, 12]);
    assert_eq!(take(&mut vehicle, Kind::Odometry, &turned, S), Err(Refusal::Frame));
    let absurd = odometry(1_000_000, LEVEL).floats(8, &[f32::NAN, 0.0, 0.0]);
    assert_eq!(take(&mut vehicle, Kind::Odometry, &absurd, S), Err(Refusal::Position));
    let failed = odometry(1_000_000, LEVEL).put(232, [-1i8 as u8]);
    assert_eq!(take(&mut vehicle, Kind::Odometry, &failed, S), Err(Refusal::Position));
    let nowhere = Fields::new(Kind::GlobalPositionInt);
    assert_eq!(
        take(&mut vehicle, Kind::GlobalPositionInt, &nowhere, S),
        Err(Refusal::Position)
    );
}

#[test]
fn a_position_is_carried_on_to_the_attitude_s_time() {
    let mut vehicle = listening();
    let early = take(
        &mut vehicle,
        Kind::AttitudeQuaternion,
        &attitude_quaternion(900, LEVEL),
        S,
    );
    assert_eq!(early, Err(Refusal::Position), "no position yet");
    assert_eq!(
        take(
            &mut vehicle,
            Kind::GlobalPositionInt,
            &global_position(1_000, 500),
            S + S / 10
        ),
        Ok(Update::Other)
    );
    let later = S + S / 10 + S / 5;
    let found = sample(take(
        &mut vehicle,
        Kind::AttitudeQuaternion,
        &attitude_quaternion(1_200, LEVEL),
        later,
    ));
    // 5 m/s to the north for 0.2 s.
    assert!((found.place.enu_m[1] - 1.0).abs() < 1e-9, "{:?}", found.place);
    let stale = take(
        &mut vehicle,
        Kind::AttitudeQuaternion,
        &attitude_quaternion(1_700, LEVEL),
        later + S / 2,
    );
    assert_eq!(stale, Err(Refusal::Position));
}

#[test]
fn odometry_goes_before_the_coarser_messages_as_long_as_it_comes() {
    let mut vehicle = listening();
    sample(take(&mut vehicle, Kind::Odometry, &odometry(1_000_000, LEVEL), S));
    assert_eq!(
        take(
            &mut vehicle,
            Kind::GlobalPositionInt,
            &global_position(1_010, 0),
            S + S / 100
        ),
        Ok(Update::Other)
    );
    let coarse = take(
        &mut vehicle,
        Kind::AttitudeQuaternion,
        &attitude_quaternion(1_020, LEVEL),
        S + S / 50,
    );
    assert_eq!(coarse, Ok(Update::Other));
    take(
        &mut vehicle,
        Kind::GlobalPositionInt,
        &global_position(1_600, 0),
        S + S * 6 / 10,
    )
    .unwrap();
    let coarse = take(
        &mut vehicle,
        Kind::AttitudeQuaternion,
        &attitude_quaternion(1_620, LEVEL),
        S + S * 62 / 100,
    );
    assert_eq!(sample(coarse).kind, Kind::AttitudeQuaternion);
}

#[test]
fn the_covariance_of_odometry_is_turned_into_the_world_s_axes() {
    let mut vehicle = listening();
    // Heading east: body forward is east, so an error of roll is about east.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let mut fields = odometry(1_000_000, [half, 0.0, 0.0, half]);
    for (k, variance) in [(0, 0.25), (6, 0.36), (11, 0.49), (15, 1e-5), (18, 2e-5), (20, 9e-5)] {
        fields = fields.floats(60 + 4 * k, &[variance]);
    }
    let cov = sample(take(&mut vehicle, Kind::Odometry, &fields, S)).cov;
    for (k, expected) in [2e-5, 1e-5, 9e-5, 0.36, 0.25, 0.49].into_iter().enumerate() {
        assert!(
            (cov[(k, k)] - expected).abs() < 1e-6 * expected.max(1e-3),
            "{k}: {}",
            cov[(k, k)]
        );
    }
}

#[test]
fn the_origin_of_local_positions_follows_from_one_that_is_given_both_ways() {
    let mut vehicle = listening();
    take(&mut vehicle, Kind::GlobalPositionInt, &global_position(1_000, 0), S).unwrap();
    let found = sample(take(&mut vehicle, Kind::Odometry, &odometry(1_000_000, LEVEL), S));
    let Origin::Start(origin) = found.place.origin else {
        panic!("{found:?}");
    };
    // 10 m to the south of the fix, 30 m below it.
    assert!(
        (origin.latitude_deg - (48.137 - 10.0 / 111_200.0)).abs() < 1e-7,
        "{origin:?}"
    );
    assert!((origin.sea_level_m - 490.0).abs() < 1e-3, "{origin:?}");
}
