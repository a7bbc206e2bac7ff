//! The part of the messages of BSI Flex 335 v2.0 that we send and read, by their published field numbers. Fields that are left out here are
//! skipped on reading.

use prost::{Enumeration, Message, Oneof};

/// `google.protobuf.Timestamp`.
#[derive(Clone, PartialEq, Message)]
pub struct Timestamp {
    #[prost(int64, tag = "1")]
    pub seconds: i64,
    #[prost(int32, tag = "2")]
    pub nanos: i32,
}

#[derive(Clone, PartialEq, Message)]
pub struct SapientMessage {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    /// UUID of the sender.
    #[prost(string, optional, tag = "2")]
    pub node_id: Option<String>,
    /// UUID of the receiver.
    #[prost(string, optional, tag = "3")]
    pub destination_id: Option<String>,
    #[prost(oneof = "Content", tags = "4, 5, 6, 7, 8, 9, 10, 11, 12")]
    pub content: Option<Content>,
}

#[derive(Clone, PartialEq, Oneof)]
pub enum Content {
    #[prost(message, tag = "4")]
    Registration(Registration),
    #[prost(message, tag = "5")]
    RegistrationAck(RegistrationAck),
    #[prost(message, tag = "6")]
    StatusReport(StatusReport),
    #[prost(message, tag = "7")]
    DetectionReport(DetectionReport),
    #[prost(message, tag = "8")]
    Task(Task),
    #[prost(message, tag = "9")]
    TaskAck(TaskAck),
    #[prost(message, tag = "10")]
    Alert(Alert),
    #[prost(message, tag = "11")]
    AlertAck(AlertAck),
    #[prost(message, tag = "12")]
    Error(ErrorReport),
}

#[derive(Clone, PartialEq, Message)]
pub struct Registration {
    #[prost(message, repeated, tag = "1")]
    pub node_definition: Vec<NodeDefinition>,
    #[prost(string, optional, tag = "2")]
    pub icd_version: Option<String>,
    #[prost(string, optional, tag = "3")]
    pub name: Option<String>,
    #[prost(string, optional, tag = "4")]
    pub short_name: Option<String>,
    #[prost(message, repeated, tag = "5")]
    pub capabilities: Vec<Capability>,
    #[prost(message, optional, tag = "6")]
    pub status_definition: Option<StatusDefinition>,
    #[prost(message, repeated, tag = "7")]
    pub mode_definition: Vec<ModeDefinition>,
    #[prost(message, repeated, tag = "10")]
    pub config_data: Vec<ConfigurationData>,
}

#[derive(Clone, PartialEq, Message)]
pub struct NodeDefinition {
    #[prost(enumeration = "NodeType", optional, tag = "1")]
    pub node_type: Option<i32>,
    #[prost(string, repeated, tag = "2")]
    pub node_sub_type: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum NodeType {
    Unspecified = 0,
    Camera = 4,
}

#[derive(Clone, PartialEq, Message)]
pub struct Capability {
    #[prost(string, optional, tag = "1")]
    pub category: Option<String>,
    #[prost(string, optional, tag = "2")]
    pub kind: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct StatusDefinition {
    #[prost(message, optional, tag = "1")]
    pub status_interval: Option<Duration>,
    #[prost(message, optional, tag = "2")]
    pub location_definition: Option<LocationType>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Duration {
    #[prost(enumeration = "TimeUnits", optional, tag = "1")]
    pub units: Option<i32>,
    #[prost(float, optional, tag = "3")]
    pub value: Option<f32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum TimeUnits {
    Unspecified = 0,
    Seconds = 4,
}

#[derive(Clone, PartialEq, Message)]
pub struct LocationType {
    #[prost(oneof = "LocationUnits", tags = "1")]
    pub units: Option<LocationUnits>,
    #[prost(oneof = "Datum", tags = "3")]
    pub datum: Option<Datum>,
}

#[derive(Clone, PartialEq, Oneof)]
pub enum LocationUnits {
    #[prost(enumeration = "LocationCoordinateSystem", tag = "1")]
    Location(i32),
}

#[derive(Clone, PartialEq, Oneof)]
pub enum Datum {
    #[prost(enumeration = "LocationDatum", tag = "3")]
    Location(i32),
}

#[derive(Clone, PartialEq, Message)]
pub struct ModeDefinition {
    #[prost(string, optional, tag = "1")]
    pub mode_name: Option<String>,
    #[prost(enumeration = "ModeType", optional, tag = "2")]
    pub mode_type: Option<i32>,
    #[prost(message, optional, tag = "4")]
    pub settle_time: Option<Duration>,
    #[prost(enumeration = "ScanType", optional, tag = "6")]
    pub scan_type: Option<i32>,
    #[prost(enumeration = "TrackingType", optional, tag = "7")]
    pub tracking_type: Option<i32>,
    #[prost(message, repeated, tag = "10")]
    pub detection_definition: Vec<DetectionDefinition>,
    #[prost(message, optional, tag = "11")]
    pub task: Option<TaskDefinition>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum ModeType {
    Unspecified = 0,
    Default = 3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum ScanType {
    Unspecified = 0,
    Fixed = 1,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum TrackingType {
    Unspecified = 0,
    Tracklet = 2,
}

#[derive(Clone, PartialEq, Message)]
pub struct DetectionDefinition {
    #[prost(message, optional, tag = "1")]
    pub location_type: Option<LocationType>,
    #[prost(message, repeated, tag = "3")]
    pub detection_report: Vec<DetectionField>,
    #[prost(message, repeated, tag = "4")]
    pub detection_class_definition: Vec<DetectionClassDefinition>,
    #[prost(message, optional, tag = "7")]
    pub geometric_error: Option<GeometricError>,
}

/// `Registration.DetectionReport`.
#[derive(Clone, PartialEq, Message)]
pub struct DetectionField {
    #[prost(enumeration = "DetectionCategory", optional, tag = "1")]
    pub category: Option<i32>,
    #[prost(string, optional, tag = "2")]
    pub kind: Option<String>,
    #[prost(string, optional, tag = "3")]
    pub units: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum DetectionCategory {
    Unspecified = 0,
    Object = 3,
}

#[derive(Clone, PartialEq, Message)]
pub struct DetectionClassDefinition {
    #[prost(message, repeated, tag = "3")]
    pub class_definition: Vec<ClassDefinition>,
}

#[derive(Clone, PartialEq, Message)]
pub struct ClassDefinition {
    #[prost(string, optional, tag = "1")]
    pub kind: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct GeometricError {
    #[prost(string, optional, tag = "1")]
    pub kind: Option<String>,
    #[prost(string, optional, tag = "2")]
    pub units: Option<String>,
    #[prost(string, optional, tag = "3")]
    pub variation_type: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct TaskDefinition {
    #[prost(int32, optional, tag = "1")]
    pub concurrent_tasks: Option<i32>,
    #[prost(message, optional, tag = "2")]
    pub region_definition: Option<RegionDefinition>,
}

#[derive(Clone, PartialEq, Message)]
pub struct RegionDefinition {
    #[prost(enumeration = "RegionType", repeated, tag = "1")]
    pub region_type: Vec<i32>,
    #[prost(message, repeated, tag = "3")]
    pub region_area: Vec<LocationType>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum RegionType {
    Unspecified = 0,
    AreaOfInterest = 1,
}

#[derive(Clone, PartialEq, Message)]
pub struct ConfigurationData {
    #[prost(string, tag = "1")]
    pub manufacturer: String,
    #[prost(string, tag = "2")]
    pub model: String,
    #[prost(string, optional, tag = "5")]
    pub software_version: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct RegistrationAck {
    #[prost(bool, optional, tag = "1")]
    pub acceptance: Option<bool>,
    #[prost(string, repeated, tag = "3")]
    pub ack_response_reason: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct StatusReport {
    #[prost(string, optional, tag = "1")]
    pub report_id: Option<String>,
    #[prost(enumeration = "System", optional, tag = "2")]
    pub system: Option<i32>,
    #[prost(enumeration = "Info", optional, tag = "3")]
    pub info: Option<i32>,
    #[prost(string, optional, tag = "5")]
    pub mode: Option<String>,
    #[prost(message, optional, tag = "7")]
    pub node_location: Option<Location>,
    #[prost(message, repeated, tag = "11")]
    pub status: Vec<Status>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum System {
    Unspecified = 0,
    Ok = 1,
    Warning = 2,
    Error = 3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum Info {
    Unspecified = 0,
    New = 1,
    Unchanged = 2,
}

#[derive(Clone, PartialEq, Message)]
pub struct Status {
    #[prost(enumeration = "StatusLevel", optional, tag = "1")]
    pub status_level: Option<i32>,
    #[prost(string, optional, tag = "3")]
    pub status_value: Option<String>,
    #[prost(enumeration = "StatusType", optional, tag = "4")]
    pub status_type: Option<i32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum StatusLevel {
    Unspecified = 0,
    Error = 4,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum StatusType {
    Unspecified = 0,
    NotDetecting = 11,
}

#[derive(Clone, PartialEq, Message)]
pub struct Location {
    /// Longitude.
    #[prost(double, optional, tag = "1")]
    pub x: Option<f64>,
    /// Latitude.
    #[prost(double, optional, tag = "2")]
    pub y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub z: Option<f64>,
    #[prost(double, optional, tag = "4")]
    pub x_error: Option<f64>,
    #[prost(double, optional, tag = "5")]
    pub y_error: Option<f64>,
    #[prost(double, optional, tag = "6")]
    pub z_error: Option<f64>,
    #[prost(enumeration = "LocationCoordinateSystem", optional, tag = "7")]
    pub coordinate_system: Option<i32>,
    #[prost(enumeration = "LocationDatum", optional, tag = "8")]
    pub datum: Option<i32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum LocationCoordinateSystem {
    Unspecified = 0,
    LatLngDegM = 1,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum LocationDatum {
    Unspecified = 0,
    Wgs84Ellipsoid = 1,
    Wgs84Geoid = 2,
}

#[derive(Clone, PartialEq, Message)]
pub struct DetectionReport {
    #[prost(string, optional, tag = "1")]
    pub report_id: Option<String>,
    #[prost(string, optional, tag = "2")]
    pub object_id: Option<String>,
    #[prost(oneof = "Place", tags = "6")]
    pub place: Option<Place>,
    #[prost(message, repeated, tag = "10")]
    pub object_info: Vec<ObjectInfo>,
    #[prost(message, repeated, tag = "11")]
    pub classification: Vec<Classification>,
    #[prost(string, optional, tag = "23")]
    pub id: Option<String>,
}

#[derive(Clone, PartialEq, Oneof)]
pub enum Place {
    #[prost(message, tag = "6")]
    Location(Location),
}

#[derive(Clone, PartialEq, Message)]
pub struct ObjectInfo {
    #[prost(string, optional, tag = "1")]
    pub kind: Option<String>,
    #[prost(string, optional, tag = "2")]
    pub value: Option<String>,
    #[prost(float, optional, tag = "3")]
    pub error: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Classification {
    #[prost(string, optional, tag = "1")]
    pub kind: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct Task {
    #[prost(string, optional, tag = "1")]
    pub task_id: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
pub struct TaskAck {
    #[prost(string, optional, tag = "1")]
    pub task_id: Option<String>,
    #[prost(enumeration = "TaskStatus", optional, tag = "2")]
    pub task_status: Option<i32>,
    #[prost(string, repeated, tag = "5")]
    pub reason: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum TaskStatus {
    Unspecified = 0,
    Rejected = 2,
}

#[derive(Clone, PartialEq, Message)]
pub struct Alert {
    #[prost(string, optional, tag = "1")]
    pub alert_id: Option<String>,
    #[prost(enumeration = "AlertType", optional, tag = "2")]
    pub alert_type: Option<i32>,
    #[prost(enumeration = "AlertStatus", optional, tag = "3")]
    pub status: Option<i32>,
    #[prost(string, optional, tag = "4")]
    pub description: Option<String>,
    #[prost(oneof = "Place", tags = "6")]
    pub place: Option<Place>,
    #[prost(enumeration = "Priority", optional, tag = "8")]
    pub priority: Option<i32>,
    #[prost(string, optional, tag = "13")]
    pub additional_information: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum AlertType {
    Unspecified = 0,
    Information = 1,
    Warning = 2,
    Critical = 3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum AlertStatus {
    Unspecified = 0,
    Active = 1,
    Acknowledge = 2,
    Reject = 3,
    Ignore = 4,
    Clear = 5,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum Priority {
    Unspecified = 0,
    Low = 1,
    Medium = 2,
    High = 3,
}

#[derive(Clone, PartialEq, Message)]
pub struct AlertAck {
    #[prost(string, optional, tag = "1")]
    pub alert_id: Option<String>,
    #[prost(enumeration = "AlertAckStatus", optional, tag = "5")]
    pub alert_ack_status: Option<i32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum AlertAckStatus {
    Unspecified = 0,
    Accepted = 1,
    Rejected = 2,
    Cancelled = 3,
}

/// `Error`.
#[derive(Clone, PartialEq, Message)]
pub struct ErrorReport {
    #[prost(string, repeated, tag = "3")]
    pub error_message: Vec<String>,
}
