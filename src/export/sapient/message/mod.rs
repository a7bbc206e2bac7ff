//! The part of the messages of BSI Flex 335 v2.0 that we send and read, by their published field numbers. Fields that are left out here are
//! skipped on reading.

mod location;
mod registration;

use prost::{Enumeration, Message, Oneof};

pub use location::*;
pub use registration::*;

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
