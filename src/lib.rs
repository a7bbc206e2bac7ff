//! oapwatch: the real-time monitor of a UAV-mounted optical access point.
//!
//! Data flows one way, from a frame over emitters, tracks and verdicts to alerts, the journal, the API and webhooks. Imports go
//! down only; ARCHITECTURE.md has the map.
// frames/v4l2/sys alone allows it, for ioctls and mapped memory, with the reason at each place.
#![deny(unsafe_code)]
// No clock is read but where an exception says why.
#![warn(clippy::disallowed_methods)]
#![cfg_attr(not(test), warn(unused_crate_dependencies))]

// The program's allocator, set in main.rs.
use mimalloc as _;

pub mod claim;
pub mod frame;
pub mod geo;
pub mod hash;
pub mod logging;
pub mod metric;
pub mod optics;
pub mod pose;
pub mod small_file;
pub mod stats;
pub mod supervisor;
pub mod time;
pub mod toml_file;
pub mod ulog;
pub mod word;

pub mod assign;
pub mod estimate;
pub mod scene;

pub mod calibrate;
pub mod claims;
pub mod frames;
pub mod platform;

pub mod monitor;

#[allow(clippy::disallowed_methods, reason = "requests have deadlines and are dated")]
pub mod api;
pub mod export;
#[allow(clippy::disallowed_methods, reason = "messages are dated")]
pub mod fleet;
pub mod journal;
pub mod notify;
#[allow(clippy::disallowed_methods, reason = "the time of an estimate is a result")]
pub mod study;

#[allow(clippy::disallowed_methods, reason = "progress and latencies are shown to people")]
pub mod cli;
pub mod config;
#[allow(clippy::disallowed_methods, reason = "it reads the clock and hands the time down")]
pub mod daemon;
pub mod hub;
#[allow(
    clippy::disallowed_methods,
    reason = "a stage's time is a metric and decides nothing"
)]
pub mod pipeline;
