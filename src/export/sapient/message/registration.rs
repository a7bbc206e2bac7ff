//! What a node says of itself when it connects.

use prost::{Enumeration, Message};

use super::location::LocationType;

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
