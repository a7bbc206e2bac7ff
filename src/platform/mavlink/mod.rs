//! The autopilot's telemetry: MAVLink over UDP or TCP, read, checked and turned into poses.

mod clock;
mod endpoint;
mod frame;
mod link;
mod reader;
mod refusal;
mod signing;
mod vehicle;

pub use clock::Relation;
pub use endpoint::{Endpoint, EndpointError};
pub use frame::{Kind, build};
pub use link::{Link, Settings};
pub use reader::{Event, Reader};
pub use refusal::Refusal;
pub use signing::{KeyError, Signing};
pub use vehicle::{Moment, Sample};
