//! Layer 4: alerts, positions, health and pose to and from other machines over NATS.
//!
//! A station publishes on `oapwatch.<site>.<station>.{alert,positions,health,pose}`. Alerts go from the journal's outbox to
//! JetStream until the server has stored them; the rest is latest-wins and lost while the link is down. It hears the claims that an
//! access network publishes.

mod claimed_height;
mod claims;
mod config;
mod connection;
pub mod message;
mod station;
mod subject;

pub use claims::Intake;
pub use config::{Config, ConfigError};
pub use connection::{Access, CAPACITY, Error, ensure_stream};
pub use station::{ENDPOINT, Station};
pub use subject::{Subject, Topic};
