//! What oapwatch knows, as messages of BSI Flex 335 v2.0.

use std::time::Duration;

use jiff::Timestamp;

use super::ids;
use super::message::{
    self as wire, Alert, AlertStatus, AlertType, Capability, ClassDefinition, Classification, ConfigurationData, Datum,
    DetectionCategory, DetectionClassDefinition, DetectionDefinition, DetectionField, DetectionReport, GeometricError,
    Info, Location, LocationCoordinateSystem, LocationDatum, LocationType, LocationUnits, ModeDefinition, ModeType,
    NodeDefinition, NodeType, ObjectInfo, Place, Priority, RegionDefinition, RegionType, Registration, ScanType,
    Status, StatusDefinition, StatusLevel, StatusReport, StatusType, System, TaskDefinition, TimeUnits, TrackingType,
};
use crate::api;
use crate::export::place::{self, World};
use crate::export::words::{sentence, track};
use crate::monitor::{self, AlertState, Severity, TrackedPosition};
use crate::word::word;

/// Status reports; the registration promises them.
pub(super) const STATUS_EVERY: Duration = Duration::from_secs(5);

/// The only mode.
const MODE: &str = "watch";
/// What every detection is.
const CLASS: &str = "Optical transmitter";
/// Metres of a degree of latitude, near enough for an error.
const METRES_A_DEGREE: f64 = 111_320.0;

pub(super) fn timestamp(at: Timestamp) -> wire::Timestamp {
    wire::Timestamp {
        seconds: at.as_second(),
        nanos: at.subsec_nanosecond(),
    }
}

fn seconds(duration: Duration) -> wire::Duration {
    wire::Duration {
        units: Some(TimeUnits::Seconds as i32),
        value: Some(duration.as_secs_f32()),
    }
}

fn location_type() -> LocationType {
    LocationType {
        units: Some(LocationUnits::Location(LocationCoordinateSystem::LatLngDegM as i32)),
        datum: Some(Datum::Location(LocationDatum::Wgs84Ellipsoid as i32)),
    }
}

/// What we are and what we will send.
pub(super) fn registration(station: &str, interval: Duration) -> Registration {
    let text = |text: &str| Some(text.to_owned());
    let field = |kind: &str, units: &str| DetectionField {
        category: Some(DetectionCategory::Object as i32),
        kind: text(kind),
        units: text(units),
    };
    let detection = DetectionDefinition {
        location_type: Some(location_type()),
        detection_report: vec![
            field("verdict", "verified, mismatch, unclaimed, pending"),
            field("energy", "J"),
            field("east_error", "m"),
            field("north_error", "m"),
        ],
        detection_class_definition: vec![DetectionClassDefinition {
            class_definition: vec![ClassDefinition { kind: text(CLASS) }],
        }],
        geometric_error: Some(GeometricError {
            kind: text("Standard Deviation"),
            units: text("decimal degrees"),
            variation_type: text("each detection states its own"),
        }),
    };
    Registration {
        node_definition: vec![NodeDefinition {
            node_type: Some(NodeType::Camera as i32),
            node_sub_type: vec!["Optical access point monitor".to_owned()],
        }],
        icd_version: text("BSI Flex 335 v2.0"),
        name: Some(format!("oapwatch {station}")),
        short_name: text(station),
        capabilities: vec![Capability {
            category: text("Detection"),
            kind: text(CLASS),
        }],
        status_definition: Some(StatusDefinition {
            status_interval: Some(seconds(STATUS_EVERY)),
            location_definition: Some(location_type()),
        }),
        mode_definition: vec![ModeDefinition {
            mode_name: text(MODE),
            mode_type: Some(ModeType::Default as i32),
            settle_time: Some(seconds(interval)),
            scan_type: Some(ScanType::Fixed as i32),
            tracking_type: Some(TrackingType::Tracklet as i32),
            detection_definition: vec![detection],
            task: Some(TaskDefinition {
                concurrent_tasks: Some(0),
                region_definition: Some(RegionDefinition {
                    region_type: vec![RegionType::AreaOfInterest as i32],
                    region_area: vec![location_type()],
                }),
            }),
        }],
        config_data: vec![ConfigurationData {
            manufacturer: "oapwatch".to_owned(),
            model: "oapwatch".to_owned(),
            software_version: text(env!("CARGO_PKG_VERSION")),
        }],
    }
}

fn location(place: &place::Place, world: &World) -> Location {
    let degrees = |metres: f64, scale: f64| metres / (METRES_A_DEGREE * scale);
    let [east, north] = place.axes_sigma_m.map_or([None; 2], |sigmas| sigmas.map(Some));
    let datum = match world.is_above_sea_level() {
        true => LocationDatum::Wgs84Geoid,
        false => LocationDatum::Wgs84Ellipsoid,
    };
    Location {
        x: Some(place.longitude_deg),
        y: Some(place.latitude_deg),
        z: Some(place.height_m),
        x_error: east.map(|m| degrees(m, place.latitude_deg.to_radians().cos().max(1e-6))),
        y_error: north.map(|m| degrees(m, 1.0)),
        z_error: place.vertical_sigma_m,
        coordinate_system: Some(LocationCoordinateSystem::LatLngDegM as i32),
        datum: Some(datum as i32),
    }
}

/// How we are. Without a status no frame has come yet.
pub(super) fn status(status: Option<&api::Status>, is_first: bool, world: &World, now: Timestamp) -> StatusReport {
    let flows = status.is_some_and(|status| status.source.flows());
    let fault = status.and_then(|status| status.source.fault.clone());
    let fault = fault.unwrap_or_else(|| "no frame has come yet".to_owned());
    let not_detecting = Status {
        status_level: Some(StatusLevel::Error as i32),
        status_value: Some(fault),
        status_type: Some(StatusType::NotDetecting as i32),
    };
    StatusReport {
        report_id: Some(ids::ulid(now, &["status"])),
        system: Some(if flows { System::Ok } else { System::Error } as i32),
        info: Some(if is_first { Info::New } else { Info::Unchanged } as i32),
        mode: Some(MODE.to_owned()),
        node_location: Some(location(&world.origin(), world)),
        status: if flows { Vec::new() } else { vec![not_detecting] },
    }
}

/// One emitter. `seq` tells one frame's report from another's; tracks are counted from `started_at`.
pub(super) fn detection(
    emitter: &TrackedPosition,
    seq: u64,
    started_at: Timestamp,
    world: &World,
    now: Timestamp,
) -> DetectionReport {
    let track = track(emitter);
    let place = world.emitter(emitter);
    let info = |kind: &str, value: String| ObjectInfo {
        kind: Some(kind.to_owned()),
        value: Some(value),
        error: None,
    };
    let mut object_info = vec![
        info("verdict", word(emitter.status)),
        info("energy", format!("{:.3e}", emitter.energy_j)),
    ];
    if let Some([east, north]) = place.axes_sigma_m {
        object_info.push(info("east_error", format!("{east:.3}")));
        object_info.push(info("north_error", format!("{north:.3}")));
    }
    DetectionReport {
        report_id: Some(ids::ulid(now, &["detection", &track, &seq.to_string()])),
        object_id: Some(ids::ulid(started_at, &["track", &track])),
        place: Some(Place::Location(location(&place, world))),
        object_info,
        classification: vec![Classification {
            kind: Some(CLASS.to_owned()),
        }],
        id: emitter.user.clone(),
    }
}

/// The same for an alert through all its life.
pub(super) fn alert_id(alert: &monitor::Alert) -> String {
    ids::ulid(alert.raised_at, &["alert", &alert.id])
}

pub(super) fn alert(alert: &monitor::Alert, is_test: bool, world: &World) -> Alert {
    let status = match alert.state {
        AlertState::Open => AlertStatus::Active,
        AlertState::Acknowledged => AlertStatus::Acknowledge,
        AlertState::Cleared => AlertStatus::Clear,
    };
    let (kind, priority) = match alert.severity {
        Severity::Info => (AlertType::Information, Priority::Low),
        Severity::Warning => (AlertType::Warning, Priority::Medium),
        Severity::Critical => (AlertType::Critical, Priority::High),
    };
    let description = match is_test {
        true => "a test event; no alert stands behind it".to_owned(),
        false => sentence(alert),
    };
    Alert {
        alert_id: Some(alert_id(alert)),
        alert_type: Some(kind as i32),
        status: Some(status as i32),
        description: Some(description),
        place: alert.x_m.map(|_| Place::Location(location(&world.alert(alert), world))),
        priority: Some(priority as i32),
        additional_information: Some(serde_json::json!({ "id": alert.id, "kind": alert.kind }).to_string()),
    }
}
