//! Floor 4: HTTP, WebSocket and the dashboard.

mod config;

pub use config::Config;
