//! Telemetry: MAVLink links and flight logs.

mod mavlink;
mod px4_log;
